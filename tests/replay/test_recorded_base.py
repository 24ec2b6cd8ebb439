"""A floating base moves along its recorded pose, and the joints feel its acceleration."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from nightly import samples

from pytest_twin import cli
from pytest_twin.trial.base_motion import BaseMotion

sys.path.insert(0, str(Path(__file__).parents[1] / "formats"))
import sensor_bags

pytestmark = pytest.mark.usefixtures("commands_in_process")
NOISE = 0.0004
"""rad. Standard deviation of the recorded positions."""
BODY = """
<mujoco><option timestep="0.002"/><worldbody><body name="trunk" pos="0 0 1">{base}
  <geom size=".1" mass="5"/><site name="imu" pos="0.1 0 0.05" euler="0 30 0"/>
  <body name="leg"><joint name="hip" axis="0 1 0" damping=".05"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass="1"/>
    <body name="foot" pos="0 0 -.3"><joint name="knee" axis="0 1 0" damping=".05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass=".5"/></body></body></body>
</worldbody><actuator><position name="hip" joint="hip" kp="20" kv=".5"/>
  <position name="knee" joint="knee" kp="6" kv=".2"/>{drives}</actuator></mujoco>"""
FREE = BODY.format(base="<freejoint/>", drives="")
GANTRY_JOINTS = {"x": "slide", "z": "slide", "yaw": "hinge", "pitch": "hinge"}
AXES = {"x": "1 0 0", "z": "0 0 1", "yaw": "0 0 1", "pitch": "0 1 0"}
GANTRY = BODY.format(
    base="".join(
        f'<joint name="{n}" type="{kind}" axis="{AXES[n]}" armature="500"/>'
        for n, kind in GANTRY_JOINTS.items()
    ),
    drives="".join(f'<position name="{n}" joint="{n}" kp="2e6" kv="4e4"/>' for n in GANTRY_JOINTS),
)
"""The plant: an ideal gantry carries the trunk, which turns too."""
COLUMNS = "base.x,base.y,base.z,base.qw,base.qx,base.qy,base.qz"


def moved(seconds: float = 4.0, frame: str = "trunk") -> tuple[np.ndarray, ...]:
    """Times, joint positions with noise, commands, and poses of a frame (x y z qw qx qy qz)."""
    model = mujoco.MjModel.from_xml_string(GANTRY)
    data = mujoco.MjData(model)
    random = np.random.default_rng(5)
    rows = []
    for k in range(int(seconds / 0.01)):
        time = 0.01 * k
        ramp = min(1.0, time)
        commands = np.array([0.3 * np.sin(2.0 * time), -0.4 * np.sin(3.0 * time)])
        gantry = [0.2 * np.sin(5.0 * time), 0.1 * np.sin(7.0 * time), time, 0.4 * np.sin(4 * time)]
        data.ctrl[:] = [*commands, *(ramp * np.array(gantry))]
        mujoco.mj_forward(model, data)
        source = data.body(frame) if frame == "trunk" else data.site(frame)
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, source.xmat.copy())
        joints = data.qpos[-2:] + NOISE * random.standard_normal(2)
        rows.append(np.concatenate([[time], joints, commands, source.xpos, quaternion]))
        mujoco.mj_step(model, data, 5)
    table = np.array(rows)
    return table[:, 0], table[:, 1:3], table[:, 3:5], table[:, 5:]


def write(folder: Path, poses: np.ndarray | None, seconds: float = 4.0) -> Path:
    time, joints, commands, _ = moved(seconds)
    head = "time,hip.position,knee.position,hip.command,knee.command"
    table = np.column_stack([time, joints, commands])
    if poses is not None:
        head, table = f"{head},{COLUMNS}", np.column_stack([table, poses])
    np.savetxt(folder / "log.csv", table, "%.9g", ",", header=head, comments="")
    (folder / "free.xml").write_text(FREE)
    return folder / "log.csv"


def replayed(folder: Path, log: Path, *options: str) -> dict:
    out = folder / "predicted.mcap"
    arguments = ["replay", str(folder / "free.xml"), str(log), "--out", str(out), *options]
    assert cli.main(arguments) == 0
    return json.loads(out.with_suffix(".json").read_text())


def rms(result: dict) -> list[float]:
    return [result["joints"][joint]["rms"] for joint in ("hip", "knee")]


def test_joints_follow_the_motion_of_the_base_to_the_noise(tmp_path: Path) -> None:
    log = write(tmp_path, moved()[3])
    result = replayed(tmp_path, log)
    assert max(rms(result)) < 1.6 * NOISE
    assert max(rms(replayed(tmp_path, log, "--base", "fixed"))) > 0.02
    assert any("the base moves along the 400 poses of base.x to base.qz" in n
               for n in result["notes"])  # fmt: skip


def test_noise_of_the_pose_is_smoothed(tmp_path: Path) -> None:
    poses = moved()[3]
    random = np.random.default_rng(1)
    poses[:, :3] += 2e-4 * random.standard_normal((len(poses), 3))
    poses[:, 3:] += 2e-4 * random.standard_normal((len(poses), 4))
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    poses[150:, 3:] *= -1.0
    assert max(rms(replayed(tmp_path, write(tmp_path, poses)))) < 5 * NOISE


@pytest.mark.parametrize("noise", [0.0, 1e-6, 3e-4])
@pytest.mark.parametrize("seeds", samples(8, always=(0, 1)))
def test_no_motion_is_smoothed_away(seeds: tuple[int, ...], noise: float) -> None:
    """Cross-validation alone chose a straight line for some of these motions."""
    time = np.arange(400) * 0.01
    for seed in seeds:
        random = np.random.default_rng(seed)
        rates = random.uniform(2.0, 8.0, 3)
        position = 0.2 * np.sin(rates * time[:, None]) * np.clip(time, 0.0, 1.0)[:, None]
        position += noise * random.standard_normal(position.shape)
        turns = np.tile([1.0, 0.0, 0.0, 0.0], (400, 1))
        motion = BaseMotion("pose", "", time, position, turns)
        left = motion.at(time)[0] - position
        assert np.sqrt(np.mean(left**2)) < 1.6 * noise + 1e-4


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: np.where(np.arange(400)[:, None] < 300, p, np.nan), "do not cover the recordin"),
        (lambda p: p + np.where(np.arange(400)[:, None] < 200, 0, [0.5, *[0] * 6]), "base jumps"),
        (lambda p: p * [1, 1, 1, 2, 2, 2, 2], "expected a quaternion of length 1, w first"),
    ],
)
def test_unusable_poses_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change, words: str
) -> None:
    log = write(tmp_path, change(moved()[3]))
    out = str(tmp_path / "p.mcap")
    assert cli.main(["replay", str(tmp_path / "free.xml"), str(log), "--out", out]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_estimates_are_refused_where_the_robot_touches_something(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The forces of a foot on the ground are not recorded."""
    log = write(tmp_path, moved()[3])
    floor = '<geom name="floor" type="plane" size="3 3 .1" pos="0 0 0.45"/><body name="trunk"'
    (tmp_path / "free.xml").write_text(FREE.replace('<body name="trunk"', floor))
    for command in ("diagnose", "identify"):
        arguments = [command, str(tmp_path / "free.xml"), str(log), "--out", str(tmp_path / "d")]
        assert cli.main(arguments) == 2
        error = capsys.readouterr().err
        assert "effects are not estimated while the robot of a recorded base pose touches" in error
        assert "'foot'" in error
        assert "mm deep" in error
        assert error.count("pytest-twin ") == 1


def test_show_says_that_the_base_moves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = write(tmp_path, moved()[3])
    assert cli.main(["show", str(tmp_path / "free.xml"), str(log)]) == 0
    shown = capsys.readouterr().out
    assert "the base moves along the 400 poses" in shown
    assert "A replay can use 3.99 s of it" in shown
    assert "next: pytest-twin replay" in shown


def test_without_a_pose_the_refusal_names_both_ways(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write(tmp_path, None)
    out = str(tmp_path / "p.mcap")
    assert cli.main(["replay", str(tmp_path / "free.xml"), str(log), "--out", out]) == 2
    error = capsys.readouterr().err
    assert "--base fixed" in error
    assert "--topics base=TOPIC, or columns base.x y z qw qx qy qz" in error


def bag(folder: Path, kind: str, frame: str) -> Path:
    """A bag with the pose of the trunk or of its sensor, on /pose."""
    time, joints, commands, poses = moved(frame=frame)
    stamps = 1_700_000_000_000_000_000 + np.rint(time * 1e9).astype(np.int64)
    values = poses[:, [0, 1, 2, 4, 5, 6, 3]]
    topics = {
        "/joint_states": (sensor_bags.STATES, stamps, joints),
        "/joint_commands": (sensor_bags.STATES, stamps, commands),
        "/pose": (kind, stamps, values),
    }
    (folder / "free.xml").write_text(FREE)
    return sensor_bags.write(folder / "log.mcap", topics, frame=frame)


@pytest.mark.parametrize(
    ("kind", "frame"), [(sensor_bags.ODOMETRY, "imu"), (sensor_bags.POSE, "trunk")]
)
def test_the_pose_is_a_topic_of_the_bag_also_of_a_frame_of_the_base(
    tmp_path: Path, kind: str, frame: str
) -> None:
    log = bag(tmp_path, kind, frame)
    options = ["--joints", "j0=hip,j1=knee", "--topics", "base=/pose"]
    assert max(rms(replayed(tmp_path, log, *options))) < 1.6 * NOISE


def test_a_wrong_topic_is_refused_with_those_that_have_poses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = bag(tmp_path, sensor_bags.ODOMETRY, "trunk")
    arguments = ["replay", str(tmp_path / "free.xml"), str(log), "--topics", "base=/odom"]
    assert cli.main([*arguments, "--out", str(tmp_path / "p.mcap")]) == 2
    error = capsys.readouterr().err
    assert "/odom: no poses of the base" in error
    assert "--topics base=/pose" in error


def test_a_golden_follows_the_recorded_pose(pytester: pytest.Pytester, tmp_path: Path) -> None:
    log = write(tmp_path, moved()[3])
    (pytester.path / "log.csv").write_text(log.read_text())
    (pytester.path / "free.xml").write_text(FREE)
    (pytester.path / "twin.yaml").write_text("name: leg\nmodel: free.xml\n")
    (pytester.path / "golden").mkdir()
    golden = "schema: 1\nkind: replay\ntarget: {recording: log.csv}\ntolerance: {angle_rms: %s}\n"
    (pytester.path / "golden" / "moves.yaml").write_text(golden % "1 mrad")
    pytester.runpytest("-p", "no:cacheprovider", "--twin-update")
    pytester.runpytest("-p", "no:cacheprovider", "golden/moves.yaml").assert_outcomes(passed=1)
