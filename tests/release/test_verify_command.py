"""``pytest-twin verify``: text, JSON and exit status."""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import jsonschema
import pytest
from release_twins import MakeRelease

from pytest_twin import cli
from pytest_twin.formats.schema import load_schema


@pytest.fixture
def twin_with_two_releases(root: Path, make: MakeRelease) -> Path:
    """A twin with two releases with the current date."""
    for _ in range(2):
        make(datetime.now(UTC))
    return root


def test_a_valid_release_prints_a_summary_and_exits_with_0(
    twin_with_two_releases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["verify", str(twin_with_two_releases / "releases" / "0002")]) == 0
    out, err = capsys.readouterr()
    first, second, third, *gaps = out.splitlines()
    assert first == "holds: release 2 of 'arm', not audited, no motion tested"
    assert second.startswith("  made ")
    assert third == "  1 golden, 6 files in the release"
    assert [gap.split(":")[0] for gap in gaps] == ["  not audited", "  thin"]
    assert err == ""


def test_verifying_a_twin_verifies_its_newest_release(
    twin_with_two_releases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["verify", str(twin_with_two_releases)]) == 0
    assert "release 2" in capsys.readouterr().out
    shutil.rmtree(twin_with_two_releases / "releases" / "0002" / "files")
    assert cli.main(["verify", str(twin_with_two_releases)]) == 1


def test_files_of_the_twin_that_changed_since_its_release_are_named(
    twin_with_two_releases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The release is valid; it is not one of the present twin."""
    model = next(twin_with_two_releases.glob("*.xml"))
    model.write_text(model.read_text() + "<!-- changed -->")
    document = twin_with_two_releases.parent / "verdict.json"
    arguments = ["verify", str(twin_with_two_releases), "--json", str(document)]
    assert cli.main(arguments) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[0].endswith(", 1 file changed since")
    assert f"  the twin is not the released one: {model.name} changed or gone; " in out
    assert json.loads(document.read_text())["changed_since"] == [model.name]
    assert cli.main(["verify", str(twin_with_two_releases / "releases" / "0002")]) == 0
    assert "changed since" not in capsys.readouterr().out


def test_goldens_that_another_engine_leaves_unproven_are_named(
    twin_with_two_releases: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(metadata, "version", lambda name: "99.0")
    document = twin_with_two_releases.parent / "verdict.json"
    assert cli.main(["verify", str(twin_with_two_releases), "--json", str(document)]) == 0
    line = capsys.readouterr().out.splitlines()[-1]
    assert "99.0 here: 1 golden not proven with it, such as" in line
    assert json.loads(document.read_text())["engines"][-1] == line.strip()


def test_an_invalid_release_prints_the_reason_and_exits_with_1(
    twin_with_two_releases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["verify", str(twin_with_two_releases / "releases" / "0001")]) == 1
    assert capsys.readouterr().out.splitlines()[-1] == ("  older than release 2 beside it")


def test_json_is_written_to_standard_output(
    twin_with_two_releases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["verify", str(twin_with_two_releases / "releases" / "0001"), "--json"]) == 1
    out, err = capsys.readouterr()
    fields = json.loads(out)
    jsonschema.validate(fields, load_schema("results/verify.schema.json"))
    assert fields["holds"] is False
    assert fields["release"]["number"] == 1
    assert fields["problems"] == [{"code": "rollback", "text": "older than release 2 beside it"}]
    assert err.startswith("does not hold: release 1")


def test_json_is_written_to_a_file_in_addition_to_the_text(
    twin_with_two_releases: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "verdict.json"
    assert cli.main(["verify", str(twin_with_two_releases), "--json", str(path)]) == 0
    assert json.loads(path.read_text())["holds"] is True
    assert capsys.readouterr().out.startswith("holds")


def test_json_is_not_written_into_a_release(
    twin_with_two_releases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    inside = twin_with_two_releases / "releases" / "0002" / "verdict.json"
    assert cli.main(["verify", str(twin_with_two_releases), "--json", str(inside)]) == 2
    assert not inside.exists()
    assert cli.main(["verify", str(twin_with_two_releases)]) == 0


def test_trusted_keys_can_be_given_as_a_folder(
    twin_with_two_releases: Path, tmp_path: Path
) -> None:
    shutil.copytree(twin_with_two_releases / "releases" / "0002", tmp_path / "received")
    assert (
        cli.main(
            ["verify", str(tmp_path / "received"), "--keys", str(twin_with_two_releases / "keys")]
        )
        == 0
    )
    assert cli.main(["verify", str(tmp_path / "received")]) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere"], "nowhere: no such release"),
        (["arm/twin.yaml"], "no such release"),
        (["arm", "--keys", "nowhere"], "nowhere: no such folder of keys"),
    ],
)
def test_unusable_input_of_verify_is_refused_in_one_line_with_exit_status_2(
    twin_with_two_releases: Path,
    arguments: list[str],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(twin_with_two_releases.parent)
    assert cli.main(["verify", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("pytest-twin verify: ")
    assert words in err
    assert len(err.splitlines()) == 1


def test_verifying_a_twin_without_releases_is_refused(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["verify", str(root)]) == 2
    assert "this twin has no release yet" in capsys.readouterr().err


def test_relative_paths_work_from_inside_a_release_folder(
    twin_with_two_releases: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(twin_with_two_releases / "releases" / "0002")
    assert cli.main(["verify", "."]) == 0
    assert cli.main(["verify", "../0001"]) == 1


def test_escape_sequences_in_file_names_are_not_printed(
    twin_with_two_releases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (twin_with_two_releases / "releases" / "0002" / "a\x1b[2Jb").touch()
    assert cli.main(["verify", str(twin_with_two_releases)]) == 1
    assert "\x1b" not in capsys.readouterr().out
