"""``diagnose --before`` of a released twin: did the model change, or the robot?"""

from __future__ import annotations

import json
import sys
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import pytest

from pytest_twin import release
from pytest_twin.changes.model_side import model_changes
from pytest_twin.cli import main
from pytest_twin.gate import since_release as since
from pytest_twin.gate.released_model import released_beside
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.twin import load_twin

sys.path.append(str(Path(__file__).parents[1] / "diagnosis"))
sys.path.append(str(Path(__file__).parents[1] / "release"))
from release_twins import html, make_draft
from two_pendulums import KP, MASS, mjcf, record

pytestmark = pytest.mark.usefixtures("commands_in_process")
JOINTS = ("left",)


@pytest.fixture
def twin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A twin with release 1, which four recordings proved."""
    home = tmp_path / "user"
    for name, folder in (("HOME", ""), ("XDG_CONFIG_HOME", "config"), ("XDG_STATE_HOME", "state")):
        monkeypatch.setenv(name, str(home / folder))
    root = tmp_path / "arm"
    for folder in ("recordings", "meshes", "golden/fk"):
        (root / folder).mkdir(parents=True)
    (root / "twin.yaml").write_text("name: arm\nmodel: model.xml\n")
    (root / "golden" / "fk" / "home.yaml").write_text("kind: fk\n")
    (root / "model.xml").write_text(mjcf(JOINTS))
    recordings = [
        record(root / "recordings" / f"old{seed}.mcap", seed, seconds=1.2, joints=JOINTS)
        for seed in range(4)
    ]
    signer, _ = release.signer(root)
    release.write(root, make_draft(root, *recordings), signer, html, now=datetime.now(UTC))
    return root


def edit(root: Path, old: str, new: str) -> None:
    path = root / "model.xml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def compare(twin: Path, out: Path) -> tuple[int, dict]:
    new = record(twin.parent / "new.mcap", 20, seconds=1.2, joints=JOINTS)
    before = sorted(map(str, (twin / "recordings").glob("old*.mcap")))
    status = main([
        "diagnose", str(twin / "twin.yaml"), str(new), "--before", *before,
        "--out", str(out), "--seconds", "30",
    ])  # fmt: skip
    return status, json.loads((out / "diagnosis.json").read_text())


def test_a_heavier_model_is_named_and_nothing_at_the_robot(twin: Path, tmp_path: Path) -> None:
    edit(twin, f'mass="{MASS}"', f'mass="{1.07 * MASS:g}"')
    _, document = compare(twin, tmp_path / "out")
    first = document["model_changes"][0]
    assert "mass left_link" in first["part"]
    assert first["share"] > 0.9
    assert not [f for f in document["findings"] if f["confidence"] >= 0.9]
    assert document["before"]["release"] == 1
    assert "Changed in the model since the release: mass left_link" in (
        (tmp_path / "out" / "report.html").read_text()
    )


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        (f'kp="{KP}"', 'kp="7.5"', "gain left"),
        ('timestep="0.002"', 'timestep="0.008"', "timestep"),
    ],
)
def test_gain_and_timestep_are_named(twin: Path, old: str, new: str, part: str) -> None:
    released = twin.parent / "released"
    released.mkdir()
    for name in ("twin.yaml", "model.xml"):
        (released / name).write_text((twin / name).read_text())
    edit(twin, old, new)
    recordings = sorted(map(str, (twin / "recordings").glob("*.mcap")))
    found = model_changes(str(twin / "twin.yaml"), str(released / "twin.yaml"), recordings, {}, {})
    assert [part in change["part"] for change in found] == [True]
    assert found[0]["share"] > 0.5


def test_replaced_and_missing_recordings_are_named(twin: Path) -> None:
    recordings = sorted((twin / "recordings").glob("*.mcap"))
    record(recordings[0], 30, seconds=1.2, joints=JOINTS)
    recordings[1].unlink()
    found = released_beside(twin / "twin.yaml", [recordings[0], *recordings[2:]])
    assert found is not None
    assert found.number is None
    assert any(n.startswith("old0.mcap is not the recording that proved") for n in found.notes)
    assert any("recordings/old1.mcap" in n and "is missing" in n for n in found.notes)


def test_another_engine_leaves_goldens_unproven(
    twin: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed = metadata.version

    def version(name: str) -> str:
        return "99.0" if name == "mujoco" else installed(name)

    monkeypatch.setattr(metadata, "version", version)
    found = released_beside(twin / "twin.yaml", [])
    assert found is not None
    (note,) = [n for n in found.notes if n.startswith("MuJoCo")]
    assert "99.0 here" in note
    assert "not proven with it" in note


def test_a_failing_run_says_whether_the_model_or_the_robot_changed(
    twin: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(since, "_SECONDS", 8.0)
    folder = tmp_path / "since"
    new = record(twin / "recordings" / "new.mcap", 20, seconds=1.2, joints=JOINTS)
    old = twin / "recordings" / "old0.mcap"
    with Sandbox() as sandbox:
        lines = since.since_release(load_twin(twin / "twin.yaml"), [new], folder, sandbox)
        assert lines[0] == "compared with the 4 recordings that proved release 1:"
        assert json.loads((folder / "diagnosis.json").read_text())["before"]["release"] == 1
        edit(twin, f'mass="{MASS}"', f'mass="{1.07 * MASS:g}"')
        lines = since.since_release(load_twin(twin / "twin.yaml"), [old], folder, sandbox)
    assert lines[0] == "old0.mcap proved release 1: the robot is as it was then"
    assert lines[1].startswith("Changed in the model since the release: mass left_link")
