"""The unit of a LeRobot data set's joints: what it says, else what its values can be."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pytest_twin.errors import FormatError
from pytest_twin.formats.recording import Notes
from pytest_twin.formats.serialized import Floats

_DEGREES = {"deg", "degree", "degrees"}
_RADIANS = {"rad", "radian", "radians"}
# No joint of an arm turns further than two turns each way.
_MOST_RADIANS = 4.0 * math.pi
# LeRobot's own drivers write degrees, or per cent of the calibrated range, and these of no other.
_OWN_DRIVERS = ("so100", "so101", "so_follower", "koch", "lekiwi", "moss", "omx", "bi_so")
_PER_CENT = 100.0


@dataclass(frozen=True)
class Unit:
    """Of positions; velocities are per second.

    Attributes:
        name: ``rad`` or ``deg``.
        scale: rad in one.
    """

    name: str
    scale: float


RADIANS, DEGREES = Unit("rad", 1.0), Unit("deg", math.pi / 180.0)


def unit_of(
    asked: str | None,
    info: Mapping[str, object],
    features: Sequence[object],
    values: Mapping[str, Floats],
    file: Path,
    notes: Notes,
) -> Unit:
    """The unit, with a note that says how it was decided.

    A declared unit goes first (``units`` of the command line, then of a feature, then of
    ``info.json``). Else values beyond two turns in rad are degrees.

    Args:
        asked: what the user says, or None.
        info: the content of ``info.json``.
        features: its descriptions of the features that are read.
        values: feature -> (n, j) values.
        file: ``info.json``, for errors.
        notes: gets the note.

    Raises:
        FormatError: a unit of another name.
    """
    if asked is not None:
        return _named(asked, file, "units")
    for declared in (*features, info):
        unit = declared.get("units", declared.get("unit")) if isinstance(declared, dict) else None
        if isinstance(unit, list) and unit and all(one == unit[0] for one in unit):
            unit = unit[0]
        if unit is not None and not isinstance(unit, str):
            raise FormatError(
                "no unit of joint angles",
                path=file,
                where="units",
                value=str(unit),
                expected="deg or rad, one for all joints",
            )
        if isinstance(unit, str):
            return _named(unit, file, "units")
    finite = [np.abs(v[np.isfinite(v)]) for v in values.values()]
    largest = max((float(v.max()) for v in finite if v.size), default=0.0)
    change = "say it with --units rad or --units deg where that is wrong"
    if largest <= _MOST_RADIANS:
        notes.add(
            "units", f"no unit is declared and no value is beyond {largest:.4g}: rad; {change}"
        )
        return RADIANS
    notes.add("units", f"no unit is declared, values reach {largest:.4g}: degrees; {change}")
    robot = str(info.get("robot_type") or "")
    if largest <= _PER_CENT and robot.startswith(_OWN_DRIVERS):
        notes.add(
            "units",
            f"a {robot} may also write per cent of each joint's calibrated range (use_degrees off; "
            "the gripper always): such values are no angles and have to be converted first",
        )
    return DEGREES


def _named(unit: str, file: Path, where: str) -> Unit:
    name = unit.strip().lower()
    if name in _DEGREES:
        return DEGREES
    if name in _RADIANS:
        return RADIANS
    raise FormatError(
        "no unit of joint angles", path=file, where=where, value=unit, expected="deg or rad"
    )
