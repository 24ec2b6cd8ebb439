"""Extract observations from a recording: ``observations.csv`` and its images."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.boards.target import KINDS
from pytest_twin.calibration.clocks.streams import PoseStream
from pytest_twin.calibration.coincident_markers import ExcludedMeasurement
from pytest_twin.calibration.plan import Plan
from pytest_twin.calibration.recordings.at_rest import (
    STILL_M,
    STILL_RAD,
    interpolate,
    rest_and_motion,
)
from pytest_twin.calibration.recordings.pose_topics import first_stamp, poses_asked, seconds
from pytest_twin.errors import RecordingError, require_at_most
from pytest_twin.formats import atomic, limits
from pytest_twin.formats.recording import TOPICS, JointSeries
from pytest_twin.formats.sensor_bag import SensorCollector, gather_sensors
from pytest_twin.formats.sensor_messages import Picture
from pytest_twin.trial.roles import refuse_final

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class ExtractedObservations:
    """Observations from one recording.

    Attributes:
        rows: one mapping column -> text for each observation.
        left_out: unusable frames, with the reason.
    """

    rows: tuple[Mapping[str, str], ...]
    left_out: tuple[ExcludedMeasurement, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Robot:
    """States of the robot: joints, or the flange if there are no joints."""

    time: FloatArray
    values: FloatArray
    still: FloatArray
    names: tuple[str, ...]
    units: tuple[str, ...]
    flange: PoseStream | None

    def cells(self, stamp: float) -> dict[str, str]:
        """Return the robot's state at a stamp as columns of ``observations.csv``."""
        if self.flange is not None:
            return pose_cells("flange", self.flange.at(np.array([stamp]))[0])
        values = interpolate(np.array([stamp]), self.time, self.values)[0]
        return {f"joint.{name}": repr(float(v)) for name, v in zip(self.names, values, strict=True)}


def pose_cells(prefix: str, pose: FloatArray) -> dict[str, str]:
    """Return a (4, 4) pose as columns of ``observations.csv``, m."""
    quaternion = np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)
    return {
        f"{prefix}.{part}": repr(float(value))
        for part, value in zip(_POSE, (*pose[:3, 3], *quaternion), strict=True)
    }


def extract(plan: Plan, path: Path, folder: Path) -> ExtractedObservations:
    """Return one observation for each time interval in which the robot stood still.

    Joint states, or the flange pose, are interpolated at the stamp of the image or target pose.

    Args:
        plan: plan that names topics and frames.
        folder: folder where images are written, as ``images/NAME``.

    Raises:
        TwinError: the recording cannot be read, lacks what the plan needs, has several topics that
            could be meant, or has the role ``final``.
    """
    state = {"state": plan.topics.get("state", TOPICS["state"])}
    bag = gather_sensors(SensorCollector(path, state))
    refuse_final(bag.metadata, path, "a calibration")
    recording = bag.recording()
    zero = first_stamp(bag, recording.series.get("state"))
    wants_images = plan.target.get("kind") in KINDS
    robot = _robot(plan, bag, recording.series.get("state"), zero)
    notes = [f"{path.name}: {note}" for note in (*map(str, recording.damage), *recording.notes)]
    if wants_images:
        topic = _image_topic(plan, bag)
        stamps = seconds(np.array(bag.stamps[topic], dtype=np.int64), zero)
        seen = None
    else:
        topic, seen = poses_asked(plan, bag, "camera_from_target", ("camera", "target"), zero)
        stamps = seen.time
    order = np.argsort(stamps, kind="stable")
    still, moving = rest_and_motion(
        stamps[order], robot.time, robot.values, robot.still, robot.names, robot.units
    )
    left_out = [
        ExcludedMeasurement(
            _span(path, order[list(one.rows)]), f"{len(one.rows)} frames: {one.why}"
        )
        for one in moving
    ]
    if not still:
        raise RecordingError(
            "the robot is at rest in no image or pose",
            path=path,
            where=topic,
            value=f"{len(stamps)} frames; first: {moving[0].why}" if moving else "no frames",
            expected="stops of half a second; two streams recorded in motion belong under streams:",
        )
    chosen = [int(order[one.middle]) for one in still]
    repeated = sum(len(one.rows) - 1 for one in still)
    if repeated:
        notes.append(
            f"{path.name}: of {repeated + len(still)} frames at rest, {len(still)} are used, one "
            "for each place where the robot stood"
        )
    rows = []
    files = _write_images(bag, topic, chosen, folder) if wants_images else {}
    for number in chosen:
        row = {"id": _name(path, number), "time": repr(float(stamps[number]))}
        row |= robot.cells(float(stamps[number]))
        if recording.metadata.get("payload"):
            row["payload"] = recording.metadata["payload"]
        if seen is None:
            if number not in files:
                left_out.append(ExcludedMeasurement(row["id"], "an image that cannot be decoded"))
                continue
            row["image"] = files[number]
        else:
            row |= pose_cells("camera_from_target", seen.poses[number])
        rows.append(row)
    return ExtractedObservations(tuple(rows), tuple(left_out), tuple(notes))


def write_table(rows: Sequence[Mapping[str, str]], path: Path) -> None:
    """Write observations as a CSV file, atomically."""
    header = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, header, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    atomic.make_folder(path.parent)
    atomic.write_text(path, text.getvalue())


def _robot(plan: Plan, bag: SensorCollector, joints: JointSeries | None, zero: int) -> _Robot:
    if joints is not None and joints.position is not None and "flange" not in plan.topics:
        there = np.isfinite(joints.position).all(axis=1)
        time = seconds(joints.stamp[there], zero)
        if len(time) > 1:
            order = np.argsort(time, kind="stable")
            width = len(joints.names)
            return _Robot(
                time[order], joints.position[there][order], np.full(width, STILL_RAD),
                joints.names, ("rad",) * width, None,
            )  # fmt: skip
    _, flange = poses_asked(plan, bag, "flange", ("base", "flange"), zero)
    turns = Rotation.from_matrix(flange.poses[:, :3, :3])
    # The sum of rotations from pose to pose measures motion; it is no orientation.
    steps = np.cumsum(np.vstack([np.zeros(3), (turns[:-1].inv() * turns[1:]).as_rotvec()]), axis=0)
    return _Robot(
        flange.time,
        np.column_stack([flange.poses[:, :3, 3], steps]),
        np.repeat([STILL_M, STILL_RAD], 3),
        ("flange x", "flange y", "flange z", "flange rx", "flange ry", "flange rz"),
        ("m",) * 3 + ("rad",) * 3,
        flange,
    )


def _image_topic(plan: Plan, bag: SensorCollector) -> str:
    topic = plan.topics.get("image")
    if topic is None and len(bag.stamps) == 1:
        topic = next(iter(bag.stamps))
    if topic is None or topic not in bag.stamps:
        raise RecordingError(
            "no topic of images" if not bag.stamps or topic else "several topics of images",
            path=bag.path,
            value=topic or ", ".join(sorted(bag.stamps)) or None,
            expected="recordings: {topics: {image: TOPIC}} of " + ", ".join(sorted(bag.stamps))
            if bag.stamps
            else "sensor_msgs Image or CompressedImage",
        )
    return topic


def _write_images(
    bag: SensorCollector, topic: str, chosen: Sequence[int], folder: Path
) -> dict[int, str]:
    """Decode the chosen images and write them; return number -> path relative to the folder."""
    require_at_most(
        len(chosen), limits.IMAGES.files_count, "too many images at rest", path=bag.path
    )
    atomic.make_folder(folder / "images")
    found: dict[int, str] = {}

    def keep(of: str, number: int, picture: Picture) -> None:
        kind = "png" if picture.grey is not None else "image"
        name = f"images/{_name(bag.path, number)}.{kind}"
        atomic.write_bytes(folder / name, _file_of(picture))
        found[number] = name

    again = replace(bag, wanted={topic: frozenset(chosen)}, picture=keep, poses={}, stamps={})
    gather_sensors(again)
    return found


def _file_of(picture: Picture) -> bytes:
    if picture.grey is None:
        return picture.file
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture.grey).save(buffer, "PNG")
    return buffer.getvalue()


def _name(path: Path, number: int) -> str:
    stem = "".join(c if c.isalnum() or c in "-_" else "_" for c in path.name.split(".")[0])
    return f"{stem}-{number:06d}"


def _span(path: Path, numbers: np.ndarray) -> str:
    first, last = _name(path, int(numbers.min())), int(numbers.max())
    return first if len(numbers) == 1 else f"{first} to {last:06d}"
