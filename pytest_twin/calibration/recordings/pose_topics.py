"""Read poses of a recording from a topic, or between two frames of ``/tf``."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.clocks.streams import PoseStream
from pytest_twin.calibration.plan import Plan
from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import JointSeries
from pytest_twin.formats.ros_serialization import Integers
from pytest_twin.formats.sensor_bag import SensorCollector
from pytest_twin.formats.sensor_messages import StampedMessage
from pytest_twin.metrics.pose import inverse, rigid

TF = ("/tf", "/tf_static")


def first_stamp(bag: SensorCollector, joints: JointSeries | None) -> int:
    """Return the first stamp of a bag, ns.

    Times count from it, because seconds since 1970 as a float have a resolution of 0.2 us only."""
    first = [min(stamps) for stamps in bag.stamps.values() if stamps]
    first += [min(one.stamp for one in poses) for name, poses in bag.poses.items()
              if poses and name != TF[1]]  # fmt: skip
    if joints is not None and len(joints.stamp):
        first.append(int(joints.stamp.min()))
    return min(first, default=0)


def seconds(stamps: Integers, zero: int) -> FloatArray:
    """Convert stamps in ns to seconds since ``zero``."""
    return np.asarray((stamps - zero) * 1e-9, dtype=np.float64)


def poses_asked(
    plan: Plan, bag: SensorCollector, what: str, frames: tuple[str, str], zero: int
) -> tuple[str, PoseStream]:
    """Return topic and poses that a plan asks for.

    Args:
        what: ``camera_from_target`` or ``flange``, a key of ``recordings.topics``.
        frames: keys of ``recordings.frames`` that name parent and child in ``/tf``.
        zero: stamp from which times count, ns.

    Raises:
        RecordingError: there are no such poses, or several topics could be meant.
    """
    names = [plan.frames.get(one) for one in frames]
    topics = sorted(set(bag.poses) - set(TF) - set(plan.topics.values()))
    topic = plan.topics.get(what)
    if topic is None and names[0] is not None and names[1] is not None:
        return TF[0], _poses_between(bag, names[0], names[1], zero)
    if topic is None and what == "camera_from_target" and len(topics) == 1:
        topic = topics[0]
    if topic is None or not bag.poses.get(topic):
        raise RecordingError(
            f"no topic of {what}" if topic or not topics else f"several topics may be {what}",
            path=bag.path,
            value=topic or ", ".join(topics) or None,
            expected=f"recordings: {{topics: {{{what}: TOPIC}}}} with a PoseStamped or "
            f"TransformStamped, or frames: {{{frames[0]}: FRAME, {frames[1]}: FRAME}} of /tf",
        )
    return topic, _stream(bag.poses[topic], zero)


def _stream(poses: Sequence[StampedMessage], zero: int) -> PoseStream:
    """Return the poses sorted by stamp, without repeated stamps."""
    stamps = np.array([one.stamp for one in poses], dtype=np.int64)
    _, rows = np.unique(stamps, return_index=True)
    values = np.array([poses[row].values for row in rows])
    transforms = rigid(Rotation.from_quat(values[:, 3:]).as_matrix(), values[:, :3])
    return PoseStream(seconds(stamps[rows], zero), transforms)


def _poses_between(bag: SensorCollector, parent: str, child: str, zero: int) -> PoseStream:
    """Return the child's poses in the parent at the stamps of the edge with the fewest messages.

    The frame of a target is published only when the target is detected; the robot's frames are
    published continuously.
    """
    edges: dict[tuple[str, str], list[StampedMessage]] = defaultdict(list)
    fixed: set[tuple[str, str]] = set()
    for topic in TF:
        for one in bag.poses.get(topic, ()):
            edges[one.parent, one.child].append(one)
            if topic == TF[1]:
                fixed.add((one.parent, one.child))
    path = _path(list(edges), parent, child)
    if path is None:
        known = sorted({name for edge in edges for name in edge})
        raise RecordingError(
            f"/tf does not connect {parent!r} and {child!r}",
            path=bag.path,
            where="recordings.frames",
            value=", ".join(known[:20]) or "no transform",
            expected="two frames of one tree",
        )
    streams = {edge: _stream(edges[edge], zero) for edge, _ in path}
    moving = [streams[edge] for edge, _ in path if edge not in fixed]
    if not moving:
        raise RecordingError(
            f"{child!r} never moves in {parent!r}",
            path=bag.path,
            where="recordings.frames",
            expected="frames with a transform on /tf between them",
        )
    time = min(moving, key=lambda stream: len(stream.time)).time
    for stream in moving:
        time = time[(time >= stream.time[0]) & (time <= stream.time[-1])]
    total = np.tile(np.eye(4), (len(time), 1, 1))
    for edge, forwards in path:
        poses = _poses_at(streams[edge], time, held=edge in fixed)
        total = total @ (poses if forwards else inverse(poses))
    return PoseStream(time, total)


def _poses_at(stream: PoseStream, time: FloatArray, *, held: bool) -> FloatArray:
    if held or len(stream.time) < 2:
        return np.tile(stream.poses[-1], (len(time), 1, 1))
    return stream.at(time)


def _path(
    edges: Sequence[tuple[str, str]], parent: str, child: str
) -> list[tuple[tuple[str, str], bool]] | None:
    """Return the edges between two frames, each with True if it leads from parent to child."""
    known: dict[str, list[tuple[tuple[str, str], bool]]] = {parent: []}
    waiting = deque([parent])
    while waiting:
        here = waiting.popleft()
        for edge in edges:
            for start, end, forwards in ((*edge, True), (*edge[::-1], False)):
                if start == here and end not in known:
                    known[end] = [*known[here], (edge, forwards)]
                    waiting.append(end)
    return known.get(child) if child in known and child != parent else None
