"""Replay goldens compare the predicted tool pose with poses measured by a tracker."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from replay_trials import ARM, series

from pytest_twin.errors import SpecError
from pytest_twin.formats.mcap import read_recording, write_recording
from pytest_twin.open_loop import frame_poses, replay
from pytest_twin.realization import load
from pytest_twin.trial import make_trial
from pytest_twin.twin import load_twin

sys.path.append(str(Path(__file__).parents[1] / "formats"))
import sensor_bags
from test_replay_check import run

TOOL_OFFSET = np.array([0.003, 0.0, -0.004])
"""Offset of the measured from the predicted tool, in the world frame, m."""
TARGET = {"recording": "moves.mcap", "tcp": "tool", "tcp_topic": "/tracker"}
TOLERANCE = {
    "tcp_position_rms": "6 mm",
    "tcp_position_max": "4 mm",
    "tcp_orientation_max": "1 mrad",
}


def add_poses(path: Path, stamps: np.ndarray, poses: np.ndarray, frame: str) -> None:
    """Write the recording again with poses (xyz in m, quaternion wxyz) on ``/tracker``."""
    with path.open("rb") as stream:
        held = [(s, c, m) for s, c, m in make_reader(stream).iter_messages()]
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        known: dict[str, int] = {}
        for schema, channel, one in held:
            if channel.topic not in known:
                own = writer.register_schema(schema.name, schema.encoding, schema.data)
                known[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, own
                )
            writer.add_message(known[channel.topic], one.log_time, one.data, one.publish_time)
        own = writer.register_schema(sensor_bags.POSE, "ros2msg", b"")
        tracker = writer.register_channel("/tracker", "cdr", own)
        for stamp, pose in zip(stamps.tolist(), poses[:, [0, 1, 2, 4, 5, 6, 3]], strict=True):
            made = sensor_bags.message(sensor_bags.POSE, stamp, pose)
            made.header.frame_id = frame
            data = bytes(sensor_bags.STORE.serialize_cdr(made, sensor_bags.POSE))
            writer.add_message(tracker, stamp, data, stamp)
        writer.finish()


def cell(folder: Path, frame: str = "world", late: float = 0.0) -> Path:
    """A twin and a recording of its own motion, with a tracker at 40 Hz offset by TOOL_OFFSET.

    ``late`` shifts the tracker's clock, s.
    """
    (folder / "twin.yaml").write_text("name: arm\nmodel: arm.xml\n")
    (folder / "arm.xml").write_text(ARM.replace('<body pos="0.3', '<body name="fore" pos="0.3'))
    time = np.arange(0.0, 2.0, 0.01)
    command = np.column_stack([0.4 * np.sin(3 * time), 0.3 - 0.2 * np.sin(5 * time)])
    still = np.tile(command[0], (len(time), 1))
    path, joints = folder / "moves.mcap", ("shoulder", "elbow")
    sent = series("/joint_commands", joints, time, position=command)
    write_recording(path, [series("/joint_states", joints, time, position=still), sent], {})
    robot = load(folder / "arm.xml", twin=load_twin(folder / "twin.yaml"))
    trial = make_trial(read_recording(path))
    (result,) = replay(robot, [trial])
    state = series("/joint_states", joints, time, position=result.position)
    write_recording(path, [state, sent], {})
    at = np.arange(0.0125, 1.9, 0.025)
    qpos = np.column_stack([np.interp(at, trial.time, column) for column in result.qpos.T])
    poses = frame_poses(robot, qpos, "tool")
    poses[:, :3] += TOOL_OFFSET
    if frame == "fore":
        poses = poses_in_frame(frame_poses(robot, qpos, frame), poses)
    add_poses(path, trial.start + np.round((at + late) * 1e9).astype(np.int64), poses, frame)
    return folder


def test_tcp_topic_compares_measured_poses_instead_of_forward_kinematics(tmp_path: Path) -> None:
    found = {m.name: m for m in run(cell(tmp_path), {"target": TARGET, "tolerance": TOLERANCE})}
    assert found["tcp_position_rms"].error == pytest.approx(np.linalg.norm(TOOL_OFFSET), rel=1e-6)
    assert found["tcp_position_rms"].passed
    assert not found["tcp_position_max"].passed
    assert found["tcp_orientation_max"].error < 1e-6
    joints = {k: v for k, v in TARGET.items() if k != "tcp_topic"}
    found = {m.name: m for m in run(tmp_path, {"target": joints, "tolerance": TOLERANCE})}
    assert found["tcp_position_max"].error < 1e-9


def poses_in_frame(parent: np.ndarray, child: np.ndarray) -> np.ndarray:
    """World poses expressed in a moving frame, computed with MuJoCo's quaternions."""
    found = np.empty_like(child)
    back = np.empty(4)
    for own, base, pose in zip(found, parent, child, strict=True):
        mujoco.mju_negQuat(back, base[3:])
        mujoco.mju_rotVecQuat(own[:3], pose[:3] - base[:3], back)
        mujoco.mju_mulQuat(own[3:], back, pose[3:])
    return found


def test_measured_poses_may_be_given_in_a_moving_link_frame(tmp_path: Path) -> None:
    folder = cell(tmp_path, frame="fore")
    found = {m.name: m for m in run(folder, {"target": TARGET, "tolerance": TOLERANCE})}
    assert found["tcp_position_max"].error == pytest.approx(np.linalg.norm(TOOL_OFFSET), rel=1e-6)
    assert found["tcp_orientation_max"].error < 1e-6


def refusal(folder: Path, **changes: Any) -> SpecError:
    with pytest.raises(SpecError) as error:
        run(folder, {"target": {**TARGET, **changes}, "tolerance": TOLERANCE})
    return error.value


def test_a_missing_pose_topic_is_refused(tmp_path: Path) -> None:
    error = refusal(cell(tmp_path), tcp_topic="/vicon")
    assert error.problem == "moves.mcap has no poses on this topic"
    assert error.expected == "/tracker"


def test_poses_that_do_not_overlap_the_states_in_time_are_refused(tmp_path: Path) -> None:
    error = refusal(cell(tmp_path, late=3600.0))
    assert error.problem == "moves.mcap has no poses while its states were recorded"
    assert error.expected == "stamps on the clock of the states"


def test_poses_in_a_frame_that_is_not_on_the_robot_are_refused(tmp_path: Path) -> None:
    error = refusal(cell(tmp_path, frame="mocap"))
    assert error.problem == "its poses are in a frame that is not between the world and the tool"
    assert error.value == "mocap"
