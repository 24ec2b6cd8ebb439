"""Write a motion as CSV, MCAP commands, and a ROS 2 JointTrajectory."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.excitation.motion import Motion
from pytest_twin.formats import atomic
from pytest_twin.formats.mcap import write_recording
from pytest_twin.formats.recording import TOPICS, JointSeries
from pytest_twin.recording_options import CommandMode

SUFFIXES = (".csv", ".mcap", ".trajectory.yaml")
_DIGITS = 12
"""Number of decimals in written motions; rounding errors are smaller."""


def write(
    path: Path,
    motion: Motion,
    joints: Sequence[str],
    slope: FloatArray,
    position: FloatArray,
    modes: Sequence[CommandMode],
) -> list[Path]:
    """Write one motion in all formats, each atomically.

    Args:
        path: path without suffix.
        joints: names of the columns.
        slope: (j,) derivative of the reading by the model's position, for velocities and
            accelerations.
        position: (n, j) positions for the robot's controller, rad or m.
        modes: (j,) command modes, for CSV and MCAP.

    Returns:
        the files.
    """
    # Round equally in all formats, so that files agree with the checked motion to 1e-12.
    position = np.round(position, _DIGITS)
    velocity = np.round(slope * motion.velocity, _DIGITS)
    acceleration = np.round(slope * motion.acceleration, _DIGITS)
    files = [path.with_name(path.name + suffix) for suffix in SUFFIXES]
    command = np.where([mode == "velocity" for mode in modes], velocity, position)
    atomic.write_text(files[0], _csv(motion.time, command, joints))
    _write_mcap(files[1], motion, joints, position, velocity, modes)
    atomic.write_text(files[2], _trajectory(motion, joints, position, velocity, acceleration))
    return files


def _csv(time: FloatArray, command: FloatArray, joints: Sequence[str]) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["time", *(f"{joint}.command" for joint in joints)])
    for at, row in zip(time, command, strict=True):
        writer.writerow([f"{at:.{_DIGITS}f}", *(f"{value:.{_DIGITS}f}" for value in row)])
    return out.getvalue()


def _write_mcap(
    path: Path,
    motion: Motion,
    joints: Sequence[str],
    position: FloatArray,
    velocity: FloatArray,
    modes: Sequence[CommandMode],
) -> None:
    stamp = np.rint(motion.time * 1e9).astype(np.int64)
    by_speed = np.array([mode == "velocity" for mode in modes])
    series = JointSeries(
        topic=TOPICS["command"],
        names=tuple(joints),
        stamp=stamp,
        log_time=stamp.copy(),
        position=None if by_speed.all() else np.where(by_speed, np.nan, position),
        velocity=np.where(by_speed, velocity, np.nan) if by_speed.any() else None,
        effort=None,
    )
    metadata = {
        "role": motion.role,
        "excitation": motion.name,
        "command_between": "interpolated",
    }
    if motion.payload is not None:
        metadata["payload"] = motion.payload
    write_recording(path, [series], metadata)


def _trajectory(
    motion: Motion,
    joints: Sequence[str],
    position: FloatArray,
    velocity: FloatArray,
    acceleration: FloatArray,
) -> str:
    """Return ``trajectory_msgs/msg/JointTrajectory`` as YAML, for ``ros2 topic pub`` or a node."""
    lines = [
        "# trajectory_msgs/msg/JointTrajectory. Only for the robot, limits and supervision that",
        "# excitation.json names, after a qualified person has approved it.",
        "header: {stamp: {sec: 0, nanosec: 0}, frame_id: ''}",
        f"joint_names: {json.dumps(list(joints), ensure_ascii=False)}",
        "points:",
    ]
    stamps = np.rint(motion.time * 1e9).astype(np.int64)
    for at, stamp in enumerate(stamps.tolist()):
        sec, nanosec = divmod(stamp, 1_000_000_000)
        lines.append(
            f"- {{positions: {position[at].tolist()}, velocities: {velocity[at].tolist()}, "
            f"accelerations: {acceleration[at].tolist()}, "
            f"time_from_start: {{sec: {sec}, nanosec: {nanosec}}}}}"
        )
    return "\n".join(lines) + "\n"
