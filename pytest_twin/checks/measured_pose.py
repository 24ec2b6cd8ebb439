"""Compare the tool's pose measured by a tracker with the pose predicted by a replay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.checks.fields import spec_error
from pytest_twin.golden import Golden

if TYPE_CHECKING:
    from pytest_twin.formats.sensor_messages import StampedMessage
    from pytest_twin.open_loop import Replayed
    from pytest_twin.realization import Realization

_WORLD = ("", "world")
_FEWEST = 2
"""Smallest number of measured poses that overlap the replay."""


def measured_and_predicted(
    golden: Golden, realization: Realization, results: Sequence[Replayed]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (n,) times in s since the first state, (n, 7) predicted and measured poses.

    Poses are at the tracker's stamps: position [m] and quaternion (w x y z) of the frame
    ``target.tcp`` in the frame that their header names: the world, or a body between the world and
    the tool.

    Args:
        golden: golden with topic and frame.
        results: replays of all sections of the recording.

    Raises:
        SpecError: the recording lacks these poses, none is in a replayed section, or their frame
            is not on the tool's chain.
        TwinError: the recording cannot contain poses.
    """
    from pytest_twin import open_loop

    topic, path = golden.target["tcp_topic"], results[0].trial.path
    poses = _poses(golden, results)
    parent = poses[0].parent
    if any(one.parent != parent for one in poses):
        raise spec_error(
            golden, "target.tcp_topic", f"{path.name} has poses in several frames", value=topic,
            expected="a topic whose poses are all in one frame",
        )  # fmt: skip
    _check_parent(golden, realization, parent)
    times, predicted, measured = [], [], []
    for result in results:
        trial = result.trial
        stamps = np.array([one.stamp for one in poses], dtype=np.int64)
        when = (stamps - trial.start) * 1e-9
        inside = np.flatnonzero((when >= trial.time[0]) & (when <= trial.time[-1]))
        if not len(inside):
            continue
        qpos = np.column_stack([
            np.interp(when[inside], trial.time, column) for column in result.qpos.T
        ])  # fmt: skip
        tool_poses = open_loop.frame_poses(realization, qpos, golden.target["tcp"])
        if parent not in _WORLD:
            parent_poses = open_loop.frame_poses(realization, qpos, parent)
            tool_poses = _relative_poses(parent_poses, tool_poses)
        values = np.array([poses[k].values for k in inside])
        times.append(trial.offset + when[inside])
        predicted.append(tool_poses)
        measured.append(values[:, [0, 1, 2, 6, 3, 4, 5]])
    if sum(map(len, times)) < _FEWEST:
        raise spec_error(
            golden, "target.tcp_topic", f"{path.name} has no poses while its states were recorded",
            value=topic, expected="stamps on the clock of the states",
        )  # fmt: skip
    return np.concatenate(times), np.concatenate(predicted), np.concatenate(measured)


def _poses(golden: Golden, results: Sequence[Replayed]) -> list[StampedMessage]:
    from pytest_twin.formats.sensor_bag import SensorCollector, gather_sensors

    topic, path = golden.target["tcp_topic"], results[0].trial.path
    bag = gather_sensors(SensorCollector(path, {}))
    if not bag.poses.get(topic):
        known = sorted(name for name, each in bag.poses.items() if each)
        raise spec_error(
            golden, "target.tcp_topic", f"{path.name} has no poses on this topic", value=topic,
            expected=", ".join(known) or "a topic of geometry_msgs/PoseStamped",
        )  # fmt: skip
    return bag.poses[topic]


def _check_parent(golden: Golden, realization: Realization, parent: str) -> None:
    if parent in _WORLD:
        return
    chain = realization.structure.chain
    known = (*realization.names("site"), *realization.names("body"))
    if parent not in known or not chain([parent]) <= chain([golden.target["tcp"]]):
        raise spec_error(
            golden, "target.tcp_topic",
            "its poses are in a frame that is not between the world and the tool", value=parent,
            expected="poses in the world, or in a body between it and the tool",
        )  # fmt: skip


def _relative_poses(parent: FloatArray, child: FloatArray) -> FloatArray:
    """Return (n, 7) poses of ``child`` in ``parent``, from both in the world."""
    from scipy.spatial.transform import Rotation

    base = Rotation.from_quat(parent[:, 3:], scalar_first=True).inv()
    turned = base * Rotation.from_quat(child[:, 3:], scalar_first=True)
    return np.column_stack([
        base.apply(child[:, :3] - parent[:, :3]), turned.as_quat(scalar_first=True),
    ])  # fmt: skip
