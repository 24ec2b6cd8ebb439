"""Read scalar signals over time from a topic: angular speed, force, or a joint quantity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import JointSeries
from pytest_twin.formats.ros_serialization import Integers
from pytest_twin.formats.sensor_bag import SensorCollector, gather_sensors

_FEWEST = 20
"""Smallest number of messages of a stream."""


@dataclass(frozen=True)
class Stream:
    """A scalar signal with the sender's stamps.

    Attributes:
        time: (n,) time since the first stamp of all streams that were read together, s, ascending.
        values: (n,) angular speed in rad/s, force in N, or the joint quantity in its own unit.
    """

    topic: str
    time: FloatArray
    values: FloatArray


def read_streams(path: Path, asked: Sequence[tuple[str, str | None, str]]) -> list[Stream]:
    """Read streams of a bag.

    Args:
        path: MCAP file, rosbag2 folder or ``.db3`` file.
        asked: for each stream its topic and, for joint states, the joint and ``speed`` or
            ``effort``.

    Raises:
        RecordingError: a topic is missing, or has fewer than 20 samples.
        TwinError: the bag cannot be read.
    """
    state = {f"{at}": topic for at, (topic, joint, _) in enumerate(asked) if joint is not None}
    bag = gather_sensors(SensorCollector(path, state))
    found = []
    for at, (topic, joint, quantity) in enumerate(asked):
        if joint is not None:
            series = bag.readers[f"{at}"].finish()
            found.append((topic, *_of_joint(path, series, topic, joint, quantity)))
        elif topic in bag.readings:
            readings = bag.readings[topic]
            table = np.array([one.values[:3] for one in readings])
            stamps = np.array([one.stamp for one in readings], dtype=np.int64)
            found.append((topic, stamps, np.linalg.norm(table, axis=1)))
        elif bag.poses.get(topic):
            found.append((topic, *_angular_speed(bag, topic)))
        else:
            known = sorted({*bag.poses, *bag.readings, *(t.name for t in bag.topics.values())})
            raise RecordingError(
                "no such stream", path=path, value=topic,
                expected="a topic of Imu, WrenchStamped or PoseStamped, or of joint states with "
                f"joint: NAME; the recording has {', '.join(known[:20]) or 'none'}",
            )  # fmt: skip
    zero = min(int(stamps.min()) for _, stamps, _ in found)
    return [_stream(path, topic, stamps, values, zero) for topic, stamps, values in found]


def _stream(path: Path, topic: str, stamps: Integers, values: FloatArray, zero: int) -> Stream:
    _, rows = np.unique(stamps, return_index=True)
    rows = rows[np.isfinite(values[rows])]
    if len(rows) < _FEWEST:
        raise RecordingError(
            "too few samples", path=path, where=topic, value=len(rows),
            expected=f"at least {_FEWEST} with different stamps",
        )  # fmt: skip
    time = np.asarray((stamps[rows] - zero) * 1e-9, dtype=np.float64)
    return Stream(topic, time, values[rows])


def _of_joint(
    path: Path, series: JointSeries | None, topic: str, joint: str, quantity: str
) -> tuple[Integers, FloatArray]:
    if series is None or joint not in series.names:
        raise RecordingError(
            "no such joint", path=path, where=topic, value=joint,
            expected="one of " + (", ".join(series.names) if series else "none: no joint states"),
        )  # fmt: skip
    at = series.names.index(joint)
    if quantity == "effort":
        if series.effort is None:
            raise RecordingError("no efforts", path=path, where=topic, expected="effort filled")
        return series.stamp, np.asarray(np.abs(series.effort[:, at]))
    if series.velocity is not None:
        return series.stamp, np.asarray(np.abs(series.velocity[:, at]))
    if series.position is None:
        raise RecordingError("no motion", path=path, where=topic, expected="position filled")
    _, rows = np.unique(series.stamp, return_index=True)
    slope = np.gradient(series.position[rows, at], series.stamp[rows] * 1e-9)
    return series.stamp[rows], np.asarray(np.abs(slope))


def _angular_speed(bag: SensorCollector, topic: str) -> tuple[Integers, FloatArray]:
    """Return the angular speed by central differences of the poses, which have no delay."""
    stamps = np.array([one.stamp for one in bag.poses[topic]], dtype=np.int64)
    _, rows = np.unique(stamps, return_index=True)
    turn = Rotation.from_quat(np.array([bag.poses[topic][row].values[3:] for row in rows]))
    stamps = stamps[rows]
    if len(rows) < 3:
        return stamps, np.zeros(len(rows))
    angle = (turn[:-2].inv() * turn[2:]).magnitude()
    return stamps[1:-1], np.asarray(angle / ((stamps[2:] - stamps[:-2]) * 1e-9))
