"""Recordings of a robot whose base floats in the model: held by a rig, or refused."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from pytest_twin import cli
from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import TOPICS
from pytest_twin.realization import load
from pytest_twin.trial import make_trial, recordings_at

pytestmark = pytest.mark.usefixtures("commands_in_process")
NOISE = 0.0004
"""rad. Standard deviation of the recorded positions."""
LEG = """
<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body name="trunk" pos="0 0 1">{base}
  <geom size=".1" mass="5"/>
  <body name="leg"><joint name="hip" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass="1"/></body></body>
  <body name="box" pos="3 0 .5"><freejoint/><geom size=".1"/></body></worldbody>
<actuator><position name="hip" joint="hip" kp="50" kv="2"/></actuator>{more}</mujoco>"""
FREE = LEG.format(base="<freejoint/>", more="{more}")


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """A twin whose base floats, and the log of the same robot on a fixed base."""
    model = mujoco.MjModel.from_xml_string(LEG.format(base="", more=""))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(3)
    rows = ["time,hip.position,hip.command"]
    for k in range(200):
        data.ctrl[0] = 0.3 * np.sin(0.05 * k)
        rows.append(f"{k * 0.01},{data.qpos[0] + NOISE * rng.standard_normal()},{data.ctrl[0]}")
        mujoco.mj_step(model, data, 5)
    (tmp_path / "log.csv").write_text("\n".join(rows))
    (tmp_path / "free.xml").write_text(FREE.format(more=""))
    (tmp_path / "twin.yaml").write_text("name: leg\nmodel: free.xml\n")
    return tmp_path


def replay(rig: Path, model: str, *options: str) -> dict:
    out = rig / "predicted.mcap"
    log = str(rig / "log.csv")
    assert cli.main(["replay", str(rig / model), log, "--out", str(out), *options]) == 0
    return json.loads(out.with_suffix(".json").read_text())


def test_a_floating_base_without_a_pose_is_refused_with_the_way_out(
    rig: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in ("replay", "diagnose", "identify"):
        arguments = [command, str(rig / "free.xml"), str(rig / "log.csv")]
        assert cli.main([*arguments, "--out", str(rig / "out.mcap")]) == 2
        error = capsys.readouterr().err
        assert "log.csv: the model's base floats (a free joint carries joint 'hip')" in error
        assert "--base fixed, or 'base: fixed' in twin.yaml" in error


def test_a_base_that_a_rig_holds_is_replayed_to_the_noise(rig: Path) -> None:
    by_option = replay(rig, "free.xml", "--base", "fixed")
    assert by_option["joints"]["hip"]["rms"] < 1.2 * NOISE
    assert "base: fixed: body 'trunk' is held at 0 0 1 m" in by_option["notes"]
    (rig / "twin.yaml").write_text("name: leg\nmodel: free.xml\nbase: fixed\n")
    assert replay(rig, "twin.yaml")["joints"] == by_option["joints"]


def test_a_golden_of_a_floating_base_is_refused_and_passes_with_a_rig(
    rig: Path, pytester: pytest.Pytester
) -> None:
    for name in ("free.xml", "log.csv", "twin.yaml"):
        (pytester.path / name).write_text((rig / name).read_text())
    (pytester.path / "golden").mkdir()
    (pytester.path / "golden" / "moves.yaml").write_text(
        "schema: 1\nkind: replay\ntarget: {recording: log.csv}\ntolerance: {angle_rms: 1 mrad}\n"
    )
    refused = pytester.runpytest("-p", "no:cacheprovider", "--twin-update")
    refused.stdout.fnmatch_lines(["*the model's base floats*"])
    (pytester.path / "twin.yaml").write_text("name: leg\nmodel: free.xml\nbase: fixed\n")
    pytester.runpytest("-p", "no:cacheprovider", "--twin-update")
    # The replay, and the audit that the update has added.
    pytester.runpytest("-p", "no:cacheprovider").assert_outcomes(passed=2)


def test_keyframes_lose_the_coordinates_of_the_base_and_objects_stay_free(tmp_path: Path) -> None:
    key = '<keyframe><key name="home" qpos="0 0 1 1 0 0 0 .25 3 0 .5 1 0 0 0"/></keyframe>'
    (tmp_path / "leg.xml").write_text(FREE.format(more=key))
    model = load(tmp_path / "leg.xml", base="fixed").model
    assert [int(kind) for kind in model.jnt_type] == [
        int(mujoco.mjtJoint.mjJNT_HINGE),
        int(mujoco.mjtJoint.mjJNT_FREE),
    ]
    assert model.key_qpos[0].tolist() == [0.25, 3, 0, 0.5, 1, 0, 0, 0]


def test_a_base_that_the_model_welds_to_the_world_is_not_refused(rig: Path) -> None:
    weld = '<equality><weld body1="trunk"/></equality>'
    (rig / "welded.xml").write_text(FREE.format(more=weld))
    (read,) = recordings_at(rig / "log.csv", TOPICS)
    make_trial(read, load(rig / "welded.xml").structure)


def test_a_floating_base_of_a_urdf_is_refused_and_held(rig: Path) -> None:
    inertia = '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" ' \
        'iyz="0"/></inertial>'  # fmt: skip
    links = "".join(f'<link name="{n}">{inertia}</link>' for n in ("map", "trunk", "leg"))
    (rig / "leg.urdf").write_text(
        f'<robot name="leg">{links}<joint name="float" type="floating"><parent link="map"/>'
        '<child link="trunk"/></joint><joint name="hip" type="continuous"><parent link="trunk"/>'
        '<child link="leg"/><axis xyz="0 1 0"/></joint></robot>'
    )
    (read,) = recordings_at(rig / "log.csv", TOPICS)
    with pytest.raises(RecordingError, match="the model's base floats"):
        make_trial(read, load(rig / "leg.urdf").structure)
    assert load(rig / "leg.urdf", base="fixed").joints == ("hip",)


def test_joints_of_a_planar_base_that_are_not_recorded_are_said(rig: Path) -> None:
    planar = '<joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide"/>'
    (rig / "planar.xml").write_text(LEG.format(base=planar, more=""))
    (read,) = recordings_at(rig / "log.csv", TOPICS)
    notes = make_trial(read, load(rig / "planar.xml").structure).notes
    assert any("nothing in the model holds them: x, z; they carry recorded" in n for n in notes)
