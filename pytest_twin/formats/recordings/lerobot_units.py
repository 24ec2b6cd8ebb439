"""Determine the unit of a LeRobot data set's joints, from its metadata or its values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pytest_twin.errors import FormatError
from pytest_twin.formats.recording import Notes
from pytest_twin.formats.ros_serialization import Floats

_DEGREES = {"deg", "degree", "degrees"}
_RADIANS = {"rad", "radian", "radians"}
# Joints of arms turn at most two turns in each direction.
_MOST_RADIANS = 4.0 * math.pi
# Only LeRobot's own drivers write per cent of the calibrated range; they may write degrees too.
_OWN_DRIVERS = ("so100", "so101", "so_follower", "koch", "lekiwi", "moss", "omx", "bi_so")
_PER_CENT = 100.0
"""Largest value of a position in per cent of its range."""


@dataclass(frozen=True)
class Unit:
    """Unit of joint positions; velocities are in this unit per second.

    Attributes:
        name: ``rad`` or ``deg``.
        scale: rad per unit.
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
    """Return the unit, and add a note with the reason.

    A declared unit takes precedence: ``units`` of the command line, then of a feature, then of
    ``info.json``. Without one, the unit is degrees if a value exceeds two turns in rad.

    Args:
        asked: unit that the user states, or None.
        info: content of ``info.json``.
        features: descriptions of the features to read.
        values: feature -> (n, j) values.
        file: path of ``info.json``, for errors.
        notes: receives the note.

    Raises:
        FormatError: the declared unit is neither ``deg`` nor ``rad``.
    """
    if asked is not None:
        return _unit_named(asked, file, "units")
    for declared in (*features, info):
        unit = declared.get("units", declared.get("unit")) if isinstance(declared, dict) else None
        if isinstance(unit, list) and unit and all(one == unit[0] for one in unit):
            unit = unit[0]
        if unit is not None and not isinstance(unit, str):
            raise FormatError(
                "not a unit of joint angles",
                path=file,
                where="units",
                value=str(unit),
                expected="deg or rad, one for all joints",
            )
        if isinstance(unit, str):
            return _unit_named(unit, file, "units")
    finite = [np.abs(v[np.isfinite(v)]) for v in values.values()]
    largest = max((float(v.max()) for v in finite if v.size), default=0.0)
    change = "if that is wrong, pass --units rad or --units deg"
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
            "the gripper always): such values are not angles and have to be converted first",
        )
    return DEGREES


def _unit_named(unit: str, file: Path, where: str) -> Unit:
    name = unit.strip().lower()
    if name in _DEGREES:
        return DEGREES
    if name in _RADIANS:
        return RADIANS
    raise FormatError(
        "not a unit of joint angles", path=file, where=where, value=unit, expected="deg or rad"
    )
