"""Unusual robots: nameless ones, slide joints, free bodies and names in other alphabets."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typed
import yaml

BIN = Path(sys.executable).parent
pytestmark = pytest.mark.usefixtures("commands_in_process")

NAMELESS = """\
<mujoco><worldbody><body><joint type="slide" axis="1 0 0"/><geom size=".1" mass="95"/></body>
</worldbody></mujoco>
"""
FREE = """\
<mujoco model="quad"><worldbody><geom name="floor" type="plane" size="5 5 .1"/>
<body name="trunk" pos="0 0 .4"><freejoint name="root"/><geom type="box" size=".2 .1 .05" mass="6"/>
<body name="leg" pos=".1 0 0"><joint name="hip" axis="0 1 0" range="-60 60" damping=".2"
armature=".01"/><geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".4"/></body></body>
</worldbody><actuator><position joint="hip" kp="30" kv="1"/></actuator></mujoco>
"""
UMLAUTS = """\
<mujoco><worldbody><geom name="Boden plan" type="plane" size="2 2 .1"/>
<body name="Wagen eins" pos="0 0 .5"><joint name="Schiene 1" type="slide" axis="1 0 0"
range="-1 1"/><geom type="box" size=".1 .1 .1" mass="2"/><site name="Spitze/ü" pos="0 0 .3"/></body>
</worldbody><actuator><motor name="Antrieb é" joint="Schiene 1" ctrlrange="-5 5"/></actuator>
</mujoco>
"""

# Effort limits that nobody looked at: a torque of 1000 N*m on some grams is unstable.
LIGHT = """\
<robot name="light"><link name="base"/>
<link name="upper"><inertial><origin xyz="0 0 -.08"/><mass value=".15"/>
<inertia ixx="4e-4" ixy="0" ixz="0" iyy="4e-4" iyz="0" izz="3e-5"/></inertial></link>
<link name="lower"><inertial><origin xyz="0 0 -.09"/><mass value=".03"/>
<inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-6"/></inertial></link>
<joint name="hip" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="1 0 0"/>
<limit effort="1000" lower="-1.57" upper="1.57" velocity="1000"/></joint>
<joint name="knee" type="revolute"><parent link="upper"/><child link="lower"/><axis xyz="0 1 0"/>
<origin xyz="0 -.04 -.16"/><limit effort="1000" lower="-3.1" upper="3.1" velocity="1000"/></joint>
</robot>
"""


def environment(tmp_path: Path) -> dict[str, str]:
    state = {"XDG_CONFIG_HOME": str(tmp_path / "config"), "XDG_STATE_HOME": str(tmp_path / "state")}
    return {**os.environ, **state}


def run(*command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return typed.run(*command, cwd=cwd, state=cwd.parent)


@pytest.mark.parametrize("text", [NAMELESS, FREE, UMLAUTS], ids=["nameless", "free", "umlauts"])
def test_init_and_release_work_for_unusual_robots(text: str, tmp_path: Path) -> None:
    folder = tmp_path / "mein Zwilling ü"
    folder.mkdir()
    (folder / "robot eins.xml").write_text(text)
    made = run("pytest-twin", "init", "robot eins.xml", cwd=folder)
    assert made.returncode == 0, made.stdout + made.stderr
    report = json.loads((folder / ".twin" / "init.json").read_text())
    assert report["failing"] == report["left_out"] == {}
    released = run("pytest", "--twin-release", cwd=folder)
    assert released.returncode == 0, released.stdout[-3000:]
    assert "release 0001 signed" in released.stdout


def test_trials_of_proposals_leave_no_log_of_the_simulator(tmp_path: Path) -> None:
    folder = tmp_path / "twin"
    folder.mkdir()
    (folder / "robot.urdf").write_text(LIGHT)
    made = typed.run_apart("pytest-twin", "init", "robot.urdf", cwd=folder, state=tmp_path)
    assert made.returncode == 0
    assert not list(folder.glob("MUJOCO_LOG*"))


def test_unnamed_joints_and_missing_frames_are_noted(tmp_path: Path) -> None:
    folder = tmp_path / "twin"
    folder.mkdir()
    (folder / "robot.xml").write_text(NAMELESS)
    made = run("pytest-twin", "init", "robot.xml", cwd=folder)
    assert "note: robot.xml: 1 of 1 joints have no name: name them" in made.stdout
    assert "nothing proposed for fk: no joint moves a frame that has a name" in made.stdout
    assert "tcp" not in (folder / "twin.yaml").read_text()


@pytest.mark.parametrize(
    ("stage", "number"),
    [("twin.yaml", signal.SIGINT), ("golden", signal.SIGTERM), (".twin", signal.SIGINT)],
)
def test_an_interrupt_leaves_the_folder_as_it_was(
    stage: str, number: signal.Signals, tmp_path: Path
) -> None:
    folder = tmp_path / "twin"
    (folder / "golden").mkdir(parents=True)
    (folder / "robot.xml").write_text(UMLAUTS)
    (folder / "golden" / "notes.txt").write_text("mine")
    child = subprocess.Popen(
        [str(BIN / "pytest-twin"), "init", "robot.xml"],
        cwd=folder, env=environment(tmp_path), stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, start_new_session=True,
        # A process in the background of a shell ignores SIGINT, and its children inherit this.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    sign = folder / "golden" / "fk" if stage == "golden" else folder / stage
    end = time.monotonic() + 120
    while not sign.exists() and child.poll() is None and time.monotonic() < end:
        time.sleep(0.005)
    os.killpg(child.pid, number)  # like Ctrl-C, which signals the whole process group
    _, stderr = child.communicate(timeout=60)
    assert child.returncode == 130
    assert stderr == "pytest-twin init: interrupted; no file is half written\n"
    assert sorted(path.name for path in folder.rglob("*")) == ["golden", "notes.txt", "robot.xml"]


def test_an_existing_spec_is_not_overwritten(tmp_path: Path) -> None:
    folder = tmp_path / "twin"
    (folder / "golden" / "fk").mkdir(parents=True)
    (folder / "robot.xml").write_text(UMLAUTS)
    mine = folder / "golden" / "fk" / "frames.yaml"
    mine.write_text("# mine\n")
    made = run("pytest-twin", "init", "robot.xml", cwd=folder)
    assert made.returncode == 2
    assert made.stderr == (
        f"pytest-twin init: {mine}: the golden exists already (expected a new folder)\n"
    )
    assert mine.read_text() == "# mine\n"
    assert sorted(path.name for path in folder.iterdir()) == ["golden", "robot.xml"]


ODD_NAMES = """\
<mujoco model="hand"><worldbody><geom name="floor: main" type="plane" size="2 2 .1"/>
<body name="robot0:palm" pos="0 0 .5"><joint name="robot0:FFJ3" axis="0 1 0" range="-60 60"
damping=".2" armature=".01"/><geom name="robot0:C/palm" type="box" size=".1 .1 .02" mass="1"/>
<site name="robot0:S palm" pos="0 0 .1"/>
<body name="con" pos=".2 0 0"><joint name="CON" axis="0 1 0" range="-60 60" damping=".2"
armature=".01"/><geom type="box" size=".1 .02 .02" mass=".3"/>
<body name="親指 [1], &quot;x&quot;" pos=".2 0 0"><joint name="con" axis="0 1 0" range="-60 60"
damping=".2" armature=".01"/><geom type="box" size=".1 .02 .02" mass=".3"/>
<body name="Con" pos=".2 0 0"><joint name="関節/1, [a] &quot;b&quot;" type="slide" axis="0 0 1"
range="-.1 .1" damping="2" armature=".1"/><geom type="box" size=".1 .02 .02" mass=".3"/>
<site name="Spitze." pos=".1 0 0"/></body></body></body></body></worldbody>
<actuator><position name="robot0:A_FFJ3" joint="robot0:FFJ3" kp="30" kv="2"/>
<position name="a/b" joint="CON" kp="20" kv="1"/><motor name="con." joint="con"/>
<velocity name="駆動" joint="関節/1, [a] &quot;b&quot;" kv="20"/></actuator>
<keyframe><key name="home: 1" qpos=".1 .1 0 0"/></keyframe></mujoco>
"""


def test_joints_with_special_characters_get_portable_file_names_and_can_be_released(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "twin"
    folder.mkdir()
    (folder / "robot.xml").write_text(ODD_NAMES)
    made = run("pytest-twin", "init", "robot.xml", cwd=folder)
    assert made.returncode == 0, made.stdout + made.stderr
    report = json.loads((folder / ".twin" / "init.json").read_text())
    assert report["failing"] == report["left_out"] == {}
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("golden/*/*"))
    assert all(re.fullmatch(r"[A-Za-z0-9_.\-/]+", file) for file in files)
    assert len({file.lower() for file in files}) == len(files)
    steps = [file for file in files if re.fullmatch(r"golden/step/.*\.yaml", file)]
    assert len(steps) == 4
    titles = [yaml.safe_load((folder / step).read_text())["title"] for step in steps]
    assert any("robot0:FFJ3" in title for title in titles)
    released = run("pytest", "--twin-release", cwd=folder)
    assert released.returncode == 0, released.stdout[-3000:]
    assert "release 0001 signed" in released.stdout
    verified = run("pytest-twin", "verify", "releases/0001", cwd=folder)
    assert verified.returncode == 0, verified.stdout + verified.stderr


def test_a_scene_without_bodies_is_refused_and_leaves_no_folder(tmp_path: Path) -> None:
    path = tmp_path / "arena.xml"
    path.write_text('<mujoco><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>')
    done = run("pytest-twin", "init", "arena.xml", "--out", "twin", cwd=tmp_path)
    assert done.returncode == 2
    assert "arena.xml: there is nothing to test in this model (expected a joint," in done.stderr
    assert not (tmp_path / "twin").exists()


MASSLESS = """\
<robot name="bare"><link name="base"/><link name="a"/><link name="b"/>
<joint name="j1" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" velocity="1" effort="9"/></joint>
<joint name="j2" type="revolute"><origin xyz="0 0 .3"/><parent link="a"/><child link="b"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="1" effort="9"/></joint></robot>
"""


def test_for_a_robot_without_masses_no_golden_that_needs_forces_is_proposed(tmp_path: Path) -> None:
    (tmp_path / "bare.urdf").write_text(MASSLESS)
    done = run("pytest-twin", "init", "bare.urdf", "--out", "twin", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "bare.urdf:1: 2 moving links have no inertia ('a', 'b'): raised to" in done.stdout
    report = json.loads((tmp_path / "twin/.twin/init.json").read_text())
    none = "no moving link has a mass; state masses in the model first"
    for kind in ("step", "settling", "frequency_response", "joint_direction", "mass_properties"):
        assert report["nothing_to_propose"][kind] == none
    assert {golden.split("/")[1] for golden in report["goldens"]} >= {"fk", "limits"}
    assert report["left_out"] == {}
    assert list(report["failing"]) == ["golden/asset/audit"]


def test_notes_of_the_same_kind_are_printed_as_one_line(tmp_path: Path) -> None:
    bare = MASSLESS.replace(' effort="9"', "")
    (tmp_path / "bare.urdf").write_text(bare)
    done = run("pytest-twin", "init", "bare.urdf", "--out", "twin", cwd=tmp_path)
    lines = [line for line in done.stdout.splitlines() if "states no effort" in line]
    assert lines == [
        "note: bare.urdf:2: joint 'j1' states no effort and has no actuator "
        "(and 1 more note of this kind in .twin/init.json)"
    ]
    report = json.loads((tmp_path / "twin/.twin/init.json").read_text())
    assert sum("states no effort" in note for note in report["notes"]) == 2
