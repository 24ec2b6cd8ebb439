"""``pytest-twin verify``: words, JSON, and exit status."""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime
from pathlib import Path

import jsonschema
import pytest
from release_twins import MakeRelease

from pytest_twin import cli
from pytest_twin.formats.schema import load_schema


@pytest.fixture
def two(root: Path, make: MakeRelease) -> Path:
    """A twin with two releases, made just now."""
    for _ in range(2):
        make(datetime.now(UTC))
    return root


def test_a_release_that_holds(two: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["verify", str(two / "releases" / "0002")]) == 0
    out, err = capsys.readouterr()
    first, second, third = out.splitlines()
    assert first == "holds: release 2 of 'arm'"
    assert second.startswith("  made ")
    assert third == "  1 golden, 6 files in the release"
    assert err == ""


def test_a_twin_stands_for_its_newest_release(
    two: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["verify", str(two)]) == 0
    assert "release 2" in capsys.readouterr().out
    shutil.rmtree(two / "releases" / "0002" / "files")
    assert cli.main(["verify", str(two)]) == 1


def test_a_release_that_does_not_hold(two: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["verify", str(two / "releases" / "0001")]) == 1
    assert capsys.readouterr().out.splitlines()[-1] == ("  older than release 2 beside it")


def test_json_on_standard_output(two: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["verify", str(two / "releases" / "0001"), "--json"]) == 1
    out, err = capsys.readouterr()
    fields = json.loads(out)
    jsonschema.validate(fields, load_schema("results/verify.schema.json"))
    assert fields["holds"] is False
    assert fields["release"]["number"] == 1
    assert fields["problems"] == [{"code": "rollback", "text": "older than release 2 beside it"}]
    assert err.startswith("does not hold: release 1")


def test_json_beside_the_text(
    two: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "verdict.json"
    assert cli.main(["verify", str(two), "--json", str(path)]) == 0
    assert json.loads(path.read_text())["holds"] is True
    assert capsys.readouterr().out.startswith("holds")


def test_a_release_is_not_written_into(two: Path, capsys: pytest.CaptureFixture[str]) -> None:
    inside = two / "releases" / "0002" / "verdict.json"
    assert cli.main(["verify", str(two), "--json", str(inside)]) == 2
    assert not inside.exists()
    assert cli.main(["verify", str(two)]) == 0


def test_keys_from_elsewhere(two: Path, tmp_path: Path) -> None:
    shutil.copytree(two / "releases" / "0002", tmp_path / "received")
    assert cli.main(["verify", str(tmp_path / "received"), "--keys", str(two / "keys")]) == 0
    assert cli.main(["verify", str(tmp_path / "received")]) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere"], "nowhere: no such release"),
        (["arm/twin.yaml"], "no such release"),
        (["arm", "--keys", "nowhere"], "nowhere: no such folder of keys"),
    ],
)
def test_unusable_input(
    two: Path,
    arguments: list[str],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(two.parent)
    assert cli.main(["verify", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("pytest-twin verify: ")
    assert words in err
    assert len(err.splitlines()) == 1


def test_a_twin_without_releases(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["verify", str(root)]) == 2
    assert "this twin has no release yet" in capsys.readouterr().err


def test_from_within_the_release(
    two: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(two / "releases" / "0002")
    assert cli.main(["verify", "."]) == 0
    assert cli.main(["verify", "../0001"]) == 1


def test_an_escape_in_a_name_reaches_no_terminal(
    two: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (two / "releases" / "0002" / "a\x1b[2Jb").touch()
    assert cli.main(["verify", str(two)]) == 1
    assert "\x1b" not in capsys.readouterr().out
