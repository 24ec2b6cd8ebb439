"""``pytest-twin rollback``: back to the last signed release, and to nothing that is not signed."""

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
def two(root: Path, make: MakeRelease) -> Path:
    """Release 1 with the model as it was; release 2 with another; another one again today."""
    make(datetime.now(UTC))
    (root / "arm.xml").write_text("<mujoco model='b'><worldbody/></mujoco>\n")
    make(datetime.now(UTC))
    (root / "arm.xml").write_text("today")
    (root / "meshes" / "link.stl").unlink()
    return root


def test_the_newest_signed_release_comes_back_and_today_is_kept(two: Path, tmp_path: Path) -> None:
    out = tmp_path / "done.json"
    assert cli.main(["rollback", "--twin", str(two), "--json", str(out)]) == 0
    done = json.loads(out.read_text())
    jsonschema.validate(done, load_schema("results/rollback.schema.json"))
    assert done["release"] == 2
    assert done["replaced"] == ["arm.xml", "meshes/link.stl"]
    assert "model='b'" in (two / "arm.xml").read_text()
    assert (two / "meshes" / "link.stl").read_bytes() == bytes(range(97))
    assert (Path(done["kept"]) / "arm.xml").read_text() == "today"
    # Once more: the release before, for the files are those of release 2 now.
    assert cli.main(["rollback", "--twin", str(two)]) == 0
    assert (two / "arm.xml").read_text() == OLD


def test_a_release_can_be_named(two: Path) -> None:
    older = str(two / "releases" / "0001")
    assert cli.main(["rollback", "--twin", str(two), "--release", older]) == 0
    assert (two / "arm.xml").read_text() == OLD


@pytest.mark.parametrize("harm", ["unsigned", "signature", "file", "key"])
def test_what_is_not_signed_is_refused(
    harm: str, two: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = two / "releases" / "0002"
    envelope = folder / "release.dsse.json"
    if harm == "unsigned":
        envelope.unlink()
    elif harm == "signature":
        other = json.loads((two / "releases" / "0001" / "release.dsse.json").read_text())
        mixed = json.loads(envelope.read_text()) | {"signatures": other["signatures"]}
        envelope.write_text(json.dumps(mixed, sort_keys=True, separators=(",", ":")))
    elif harm == "file":
        (folder / "files" / "arm.xml").write_text("<mujoco/>")
    else:
        for key in (two / "keys").iterdir():
            key.unlink()
    before = (two / "arm.xml").read_text()
    assert cli.main(["rollback", "--twin", str(two), "--release", str(folder)]) == 2
    assert "does not hold" in capsys.readouterr().err
    assert (two / "arm.xml").read_text() == before
    if harm == "key":
        return
    # Without a name, the one before it that holds is taken.
    assert cli.main(["rollback", "--twin", str(two)]) == 0
    assert (two / "arm.xml").read_text() == OLD


def test_a_twin_without_a_signed_release_is_refused(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["rollback", "--twin", str(root)]) == 2
    assert "no release to go back to" in capsys.readouterr().err
