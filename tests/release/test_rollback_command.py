"""``pytest-twin rollback`` restores the last signed release and nothing unsigned."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import jsonschema
import pytest
from release_twins import MakeRelease

from pytest_twin import cli
from pytest_twin.formats.schema import load_schema

OLD = "<mujoco><worldbody/></mujoco>\n"


@pytest.fixture
def twin_with_two_releases(root: Path, make: MakeRelease) -> Path:
    """A twin with two releases of different models and a third, unreleased model."""
    make(datetime.now(UTC))
    (root / "arm.xml").write_text("<mujoco model='b'><worldbody/></mujoco>\n")
    make(datetime.now(UTC))
    (root / "arm.xml").write_text("today")
    (root / "meshes" / "link.stl").unlink()
    return root


def test_rollback_restores_the_newest_release_and_keeps_a_copy_of_replaced_files(
    twin_with_two_releases: Path, tmp_path: Path
) -> None:
    out = tmp_path / "done.json"
    assert cli.main(["rollback", "--twin", str(twin_with_two_releases), "--json", str(out)]) == 0
    done = json.loads(out.read_text())
    jsonschema.validate(done, load_schema("results/rollback.schema.json"))
    assert done["release"] == 2
    assert done["replaced"] == ["arm.xml", "meshes/link.stl"]
    assert "model='b'" in (twin_with_two_releases / "arm.xml").read_text()
    assert (twin_with_two_releases / "meshes" / "link.stl").read_bytes() == bytes(range(97))
    assert (Path(done["kept"]) / "arm.xml").read_text() == "today"
    # The files are those of release 2 now: a second rollback restores release 1.
    assert cli.main(["rollback", "--twin", str(twin_with_two_releases)]) == 0
    assert (twin_with_two_releases / "arm.xml").read_text() == OLD


def test_rollback_restores_a_given_release(twin_with_two_releases: Path) -> None:
    older = str(twin_with_two_releases / "releases" / "0001")
    assert cli.main(["rollback", "--twin", str(twin_with_two_releases), "--release", older]) == 0
    assert (twin_with_two_releases / "arm.xml").read_text() == OLD


@pytest.mark.parametrize("harm", ["unsigned", "signature", "file", "key"])
def test_rollback_refuses_a_release_that_is_not_validly_signed(
    harm: str, twin_with_two_releases: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = twin_with_two_releases / "releases" / "0002"
    envelope = folder / "release.dsse.json"
    if harm == "unsigned":
        envelope.unlink()
    elif harm == "signature":
        other = json.loads(
            (twin_with_two_releases / "releases" / "0001" / "release.dsse.json").read_text()
        )
        mixed = json.loads(envelope.read_text()) | {"signatures": other["signatures"]}
        envelope.write_text(json.dumps(mixed, sort_keys=True, separators=(",", ":")))
    elif harm == "file":
        (folder / "files" / "arm.xml").write_text("<mujoco/>")
    else:
        for key in (twin_with_two_releases / "keys").iterdir():
            key.unlink()
    before = (twin_with_two_releases / "arm.xml").read_text()
    assert (
        cli.main(["rollback", "--twin", str(twin_with_two_releases), "--release", str(folder)]) == 2
    )
    assert "does not hold" in capsys.readouterr().err
    assert (twin_with_two_releases / "arm.xml").read_text() == before
    if harm == "key":
        return
    # Without a given release, the previous valid one is restored.
    assert cli.main(["rollback", "--twin", str(twin_with_two_releases)]) == 0
    assert (twin_with_two_releases / "arm.xml").read_text() == OLD


def test_rollback_without_a_signed_release_is_refused(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["rollback", "--twin", str(root)]) == 2
    assert "no release to restore" in capsys.readouterr().err
