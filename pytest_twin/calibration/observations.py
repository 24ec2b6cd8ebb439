"""Observations of a calibration, as arrays."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.plan import QUATERNION_TOLERANCE
from pytest_twin.errors import FormatError
from pytest_twin.formats.observations import ObservationTable, read_observations

SIDES = ("+", "-")
"""Approach direction of a pose: increasing or decreasing joint positions."""

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_POSES = ("flange", "camera_from_target")
_MEANING = (
    "id, time, joint.NAME, flange.x y z qw qx qy qz, camera_from_target.x y z qw qx qy qz, "
    "image, point.NAME.x y z, pivot, payload, pose, approach"
)


@dataclass(frozen=True)
class Observations:
    """Rows of observations; NaN where a row does not have a value.

    Attributes:
        ids: id of each row.
        time: (rows,) s, or None.
        joints: joint -> (rows,) rad or m.
        flange: (rows, 4, 4) ``transform_base_to_flange``, m, or None.
        camera_from_target: (rows, 4, 4) transform from the target's frame to the camera's, m, or
            None.
        points: marker -> (rows, 3) position in the frame of the measuring device, m.
        images: relative path of each row's image, or None.
        pivots: name of the fixed point that holds the tool's tip, ``""`` for none; or None.
        payloads: name of the payload in each row, ``""`` if not stated; or None.
        poses: name of the pose that the robot returned to, ``""`` if not stated; or None.
        approaches: approach direction of the pose, ``+`` or ``-``, ``""`` if not stated; or None.
        notes: messages on columns that were ignored.
    """

    ids: tuple[str, ...]
    time: FloatArray | None = None
    joints: Mapping[str, FloatArray] = field(default_factory=dict)
    flange: FloatArray | None = None
    camera_from_target: FloatArray | None = None
    points: Mapping[str, FloatArray] = field(default_factory=dict)
    images: tuple[str, ...] | None = None
    pivots: tuple[str, ...] | None = None
    payloads: tuple[str, ...] | None = None
    poses: tuple[str, ...] | None = None
    approaches: tuple[str, ...] | None = None
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.ids)

    def rows(self, chosen: Sequence[int] | np.ndarray) -> Observations:
        """Return the observations of the chosen rows, in that order."""
        at = np.asarray(chosen, dtype=int)

        def cut(array: FloatArray | None) -> FloatArray | None:
            return None if array is None else array[at]

        def words(names: tuple[str, ...] | None) -> tuple[str, ...] | None:
            return None if names is None else tuple(names[i] for i in at)

        return replace(
            self,
            ids=tuple(self.ids[i] for i in at),
            time=cut(self.time),
            joints={name: values[at] for name, values in self.joints.items()},
            flange=cut(self.flange),
            camera_from_target=cut(self.camera_from_target),
            points={name: values[at] for name, values in self.points.items()},
            images=words(self.images),
            pivots=words(self.pivots),
            payloads=words(self.payloads),
            poses=words(self.poses),
            approaches=words(self.approaches),
        )


def id_order(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a key that sorts ids, with the numbers in them by their value."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return tuple((0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts)


def in_order(observations: Observations, *, is_motion: bool) -> Observations:
    """Return the rows by time, or by id where a row has no time.

    The order of the rows in the file then has no influence.

    Args:
        observations: the rows.
        is_motion: whether rows without a time are in the order of a motion, which is kept.
    """
    time, ids = observations.time, observations.ids
    if time is not None and np.isfinite(time).all():
        stamps = time.tolist()
        return observations.rows(
            sorted(range(len(ids)), key=lambda row: (stamps[row], id_order(ids[row])))
        )
    if is_motion:
        return observations
    return observations.rows(sorted(range(len(ids)), key=lambda row: id_order(ids[row])))


def load_observations(path: Path) -> Observations:
    """Read ``observations.csv``.

    Raises:
        PathError, LimitError: as :func:`pytest_twin.formats.observations.read_observations`.
        FormatError: a cell is unusable, a pose is incomplete, or an id occurs twice. The error
            names line and column.
    """
    return from_table(read_observations(path))


def from_table(table: ObservationTable) -> Observations:
    """Return the observations in a table."""
    names = set(table.header)
    ids = table.cells.get("id") or tuple(str(i) for i in range(len(table)))
    seen: dict[str, int] = {}
    for row, name in enumerate(ids):
        if name in seen or not name:
            raise table.error(
                row,
                "id",
                "an id occurs twice" if name else "no id",
                value=name or None,
                expected="a different id for each observation",
            )
        seen[name] = row
    joints = {
        name.removeprefix("joint."): table.numbers(name)
        for name in table.header
        if name.startswith("joint.")
    }
    markers = list(
        dict.fromkeys(
            name.removeprefix("point.").rpartition(".")[0]
            for name in table.header
            if name.startswith("point.")
        )
    )
    points = {}
    for marker in markers:
        _complete(table, f"point.{marker}", ("x", "y", "z"))
        points[marker] = np.stack([table.numbers(f"point.{marker}.{a}") for a in "xyz"], axis=1)
    poses = {name: _poses(table, name) for name in _POSES if any(_with_prefix(names, name))}
    known = {"id", "time", "image", "pivot", "payload", "pose", "approach"}
    left_out = [
        name
        for name in table.header
        if name not in known and name.partition(".")[0] not in ("joint", "point", *_POSES)
    ]
    found = Observations(
        ids=ids,
        time=table.numbers("time") if "time" in names else None,
        joints=joints,
        points=points,
        flange=poses.get("flange"),
        camera_from_target=poses.get("camera_from_target"),
        images=table.cells.get("image"),
        pivots=table.cells.get("pivot"),
        payloads=table.cells.get("payload"),
        poses=table.cells.get("pose"),
        approaches=_approaches(table),
        notes=(f"columns without a meaning are left out: {', '.join(left_out)}",)
        if left_out
        else (),
    )
    if not joints and found.flange is None and found.images is None:
        raise FormatError(
            "no column of a joint or of the flange",
            path=table.path,
            line=1,
            value=", ".join(table.header),
            expected=_MEANING,
        )
    return found


def _approaches(table: ObservationTable) -> tuple[str, ...] | None:
    found = table.cells.get("approach")
    for row, side in enumerate(found or ()):
        if side and side not in SIDES:
            raise table.error(
                row,
                "approach",
                "no approach direction",
                value=side,
                expected="+ (rising position) or - (falling position)",
            )
    return found


def _with_prefix(names: set[str], prefix: str) -> list[str]:
    return [name for name in names if name.startswith(prefix + ".")]


def _complete(table: ObservationTable, prefix: str, parts: Sequence[str]) -> None:
    missing = [f"{prefix}.{part}" for part in parts if f"{prefix}.{part}" not in table.header]
    if missing:
        raise FormatError(
            "a column is missing",
            path=table.path,
            line=1,
            where=prefix,
            value=", ".join(missing),
            expected=", ".join(f"{prefix}.{part}" for part in parts),
        )


def _poses(table: ObservationTable, prefix: str) -> FloatArray:
    _complete(table, prefix, _POSE)
    columns = np.stack([table.numbers(f"{prefix}.{part}") for part in _POSE], axis=1)
    there = np.isfinite(columns)
    for row in np.flatnonzero(there.any(axis=1) & ~there.all(axis=1)):
        missing = _POSE[int(np.flatnonzero(~there[row])[0])]
        raise table.error(
            int(row), f"{prefix}.{missing}", "an incomplete pose", expected="seven numbers, or none"
        )
    poses = np.full((len(table), 4, 4), np.nan)
    full = there.all(axis=1)
    lengths = np.linalg.norm(columns[:, 3:], axis=1)
    for row in np.flatnonzero(full & (np.abs(lengths - 1.0) > QUATERNION_TOLERANCE)):
        raise table.error(
            int(row),
            f"{prefix}.qw",
            "a quaternion that is not of unit length",
            value=f"length {lengths[row]:.4g}",
            expected="qw qx qy qz of length 1",
        )
    poses[full] = np.eye(4)
    if full.any():
        quaternions = np.roll(columns[full, 3:], -1, axis=1)
        poses[full, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
        poses[full, :3, 3] = columns[full, :3]
    return poses
