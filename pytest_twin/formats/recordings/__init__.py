"""Read recordings of any format through one reader per format.

Readers are classes with the attributes and methods of :class:`Reader`, registered as entry points
``pytest_twin.recordings``. If several readers recognize a path, the first by name is used; readers
of other packages come before the package's own.
"""

from __future__ import annotations

import functools
import stat
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path

from pytest_twin.errors import FormatError, PathError
from pytest_twin.formats import base_pose
from pytest_twin.formats.paths import follow
from pytest_twin.formats.recording import TOPICS, Recording
from pytest_twin.formats.recordings.base import BagReader, Reader, ReadingOptions
from pytest_twin.installed import is_own, load_plugin, refuse_stale_installation
from pytest_twin.words import list_names

__all__ = ["Reader", "ReadingOptions", "read_one", "read_recordings", "reader_of", "readers"]

_ROS1_BAG = b"#ROSBAG V"
"""First bytes of a bag of ROS 1."""
_GROUP = "pytest_twin.recordings"
KINDS = (
    "an MCAP file, a rosbag2 folder, a .db3 file, a CSV file (.csv, .csv.gz), or the folder of a "
    "LeRobot data set"
)


def read_recordings(
    path: Path,
    topics: Mapping[str, str] = TOPICS,
    *,
    columns: Mapping[str, str] | None = None,
    units: str | None = None,
    time_unit: str | None = None,
    motor_calibration: Path | None = None,
    has_signals: bool = False,
) -> list[Recording]:
    """Read joint states and commands from a recording of any format.

    Args:
        path: a file or folder; links are refused.
        topics: role (``state``, ``command``, ``base``) -> topic, for formats with topics.
        columns: for a CSV file: header -> meaning of the column (``time``, ``elbow.position``),
            or the inverse mapping.
        units: ``deg`` or ``rad``, or for a LeRobot data set ``percent``, if the recording states no
            unit or a wrong one.
        time_unit: for a CSV file: unit of its times.
        motor_calibration: for a LeRobot data set: the JSON file of the arm's motors.
        has_signals: whether unit and side of the positions are declared elsewhere (``signals:``).

    Returns:
        one recording, or one for each episode of a data set.

    Raises:
        PathError: missing, a link, or neither a regular file nor a folder.
        FormatError: no reader recognizes the path, or its content violates its format.
        LimitError: the recording exceeds the limits of its format.
        RecordingError: the recording has no usable content.
    """
    reader = reader_of(path)
    if "LeRobot" not in reader.kind and (motor_calibration is not None or units == "percent"):
        raise FormatError(
            "motor calibrations and per cent are of LeRobot data sets", path=path,
            value=reader.kind, expected="no --motor-calibration, and --units rad or deg",
        )  # fmt: skip
    base = topics.get(base_pose.ROLE)
    topics = {role: topic for role, topic in topics.items() if role != base_pose.ROLE}
    options = ReadingOptions(
        topics, columns or {}, units, time_unit, motor_calibration, has_signals
    )
    found = list(reader.read(path, options))
    if base is not None and isinstance(reader, BagReader):
        poses = base_pose.poses_of_topic(path, base)
        found = [replace(one, base=poses) for one in found]
    return [_from_degrees(one) for one in found] if units == "deg" else found


def _from_degrees(recording: Recording) -> Recording:
    """The recording in rad, apart from joints whose unit the recording or its reader states."""
    series = {role: one.from_degrees() for role, one in recording.series.items()}
    changed = {
        name
        for one in series.values()
        for name, is_degree in zip(one.names, one.degrees, strict=True)
        if is_degree
    }
    if not changed:
        return recording
    note = f"positions and velocities of {list_names(sorted(changed))} are read as degrees"
    return replace(recording, series=series, notes=(*recording.notes, note))


def read_one(
    path: Path,
    topics: Mapping[str, str] = TOPICS,
    *,
    columns: Mapping[str, str] | None = None,
    units: str | None = None,
    time_unit: str | None = None,
    motor_calibration: Path | None = None,
    has_signals: bool = False,
) -> Recording:
    """Read the single recording at a path.

    Raises:
        FormatError: the path is a data set of several episodes, or as :func:`read_recordings`.
    """
    found = read_recordings(
        path,
        topics,
        columns=columns,
        units=units,
        time_unit=time_unit,
        motor_calibration=motor_calibration,
        has_signals=has_signals,
    )
    if len(found) != 1:
        raise FormatError(
            "holds several recordings",
            path=path,
            value=f"{len(found)} episodes",
            expected="one: --episode N, or a file that pytest-twin convert writes of an episode",
        )
    return found[0]


def reader_of(path: Path) -> Reader:
    """Return the reader that recognizes a path.

    Raises:
        PathError: missing, a link, or neither a regular file nor a folder.
        FormatError: no reader recognizes it.
        SpecError: pytest-twin's own readers are not registered.
    """
    try:
        mode = follow(path).lstat().st_mode
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        problem = "no such file or folder" if isinstance(error, FileNotFoundError) else reason
        raise PathError(problem, path=path, expected=KINDS) from None
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise PathError("neither a regular file nor a folder", path=path, expected=KINDS)
    for reader in readers():
        if reader.reads(path):
            return reader
    refuse_stale_installation(entry_points(group=_GROUP), _GROUP)
    if path.is_file() and _is_ros1_bag(path):
        raise FormatError(
            "a bag of ROS 1, which is not read",
            path=path,
            expected=f"pip install rosbags && rosbags-convert --src {path.name} --dst {path.stem}, "
            f"and then {path.stem}",
        )
    raise FormatError("no recording that can be read", path=path, expected=KINDS)


@functools.cache
def readers() -> Sequence[Reader]:
    """Return all installed readers, those of other packages first.

    Raises:
        SpecError: a reader cannot be loaded.
    """
    points = sorted(entry_points(group=_GROUP), key=lambda point: (is_own(point), point.name))
    return tuple(load_plugin(point, "recording reader") for point in points)


def _is_ros1_bag(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(_ROS1_BAG)) == _ROS1_BAG
