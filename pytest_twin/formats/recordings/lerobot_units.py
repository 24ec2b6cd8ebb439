"""Determine the unit of a LeRobot data set's joints, from its metadata or its values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pytest_twin.errors import FormatError
from pytest_twin.formats.recording import DEGREE, Notes
from pytest_twin.formats.recordings.lerobot_calibration import GRIPPER, MotorRange
from pytest_twin.formats.ros_serialization import Floats
from pytest_twin.words import list_names

_NAMES = {
    "deg": "deg", "degree": "deg", "degrees": "deg",
    "rad": "rad", "radian": "rad", "radians": "rad",
    "percent": "percent",
}  # fmt: skip
# Joints of arms turn at most two turns in each direction.
_MOST_RADIANS = 4.0 * math.pi
# Only LeRobot's own drivers write per cent of the calibrated range; they may write degrees too.
_OWN_DRIVERS = ("so100", "so101", "so_follower", "koch", "lekiwi", "moss", "omx", "bi_so")
_PER_CENT = 100.0
"""Largest value of a position in per cent of its range."""
# Positions in per cent are clipped at their ends; single precision and filters move them a little.
_AT_END = 0.1
# Degrees by which an arm may be beyond its calibrated range.
_BEYOND = 2.0
_WAY_OUT = (
    "--units deg, or --units percent with --motor-calibration FILE.json of the arm "
    "(calibration/robots/ in LeRobot's cache)"
)


@dataclass(frozen=True)
class Positions:
    """Positions of a data set's features.

    Attributes:
        names: feature -> joint of each value that is a position.
        values: feature -> (n, j) these values.
    """

    names: Mapping[str, Sequence[str]]
    values: Mapping[str, Floats]

    def largest(self, *, grippers: bool) -> float:
        """Largest absolute value, with or without joints whose name ends in ``gripper``."""
        largest = 0.0
        for feature, table in self.values.items():
            for column, name in enumerate(self.names[feature]):
                finite = table[np.isfinite(table[:, column]), column]
                if finite.size and (grippers or not is_gripper(name)):
                    largest = max(largest, float(np.abs(finite).max()))
        return largest


@dataclass(frozen=True)
class Unit:
    """Unit of joint positions; velocities are in this unit per second.

    Attributes:
        name: ``rad``, ``deg`` or ``percent``.
        motors: motor -> its calibrated range, where one is given.
        unknown: joints in per cent of a range that is not known.
    """

    name: str
    motors: Mapping[str, MotorRange]
    unknown: frozenset[str] = frozenset()

    def angles(self, joint: str, values: Floats) -> Floats:
        """Return the positions of a joint in rad."""
        motor = self.motors.get(joint)
        if motor is not None and (self.name == "percent" or is_gripper(joint)):
            return motor.angles(values, from_closed=is_gripper(joint))
        return values * self.factor

    def velocities(self, joint: str, values: Floats) -> Floats:
        """Return the velocities of a joint in rad/s."""
        motor = self.motors.get(joint)
        if motor is not None and (self.name == "percent" or is_gripper(joint)):
            zero = motor.angles(np.zeros(1), from_closed=is_gripper(joint))
            return motor.angles(values, from_closed=is_gripper(joint)) - zero
        return values * self.factor

    @property
    def factor(self) -> float:
        """rad per unit."""
        return DEGREE if self.name == "deg" else 1.0


@dataclass(frozen=True)
class Declared:
    """What is known of the unit before the values are read.

    Attributes:
        asked: unit that the user states, or None.
        motors: calibrated ranges; empty without a calibration.
        info: content of ``info.json``.
        features: descriptions of the features to read.
        file: path of ``info.json``, for errors.
    """

    asked: str | None
    motors: Mapping[str, MotorRange]
    info: Mapping[str, object]
    features: Sequence[object]
    file: Path


def is_gripper(joint: str) -> bool:
    """Whether LeRobot's drivers record a joint from 0 to 100 per cent."""
    return joint.endswith(GRIPPER)


def unit_of(declared: Declared, positions: Positions, notes: Notes) -> Unit:
    """Return the unit, and add a note with the reason.

    A declared unit takes precedence: ``units`` of the command line, then of a feature, then of
    ``info.json``. Without one, the unit is degrees if a value exceeds two turns in rad, unless it
    may be per cent.

    Raises:
        FormatError: the declared unit is none, or the values may be degrees or per cent.
    """
    name = _stated(declared) or _detected(declared, positions, notes)
    joints = {joint for names in positions.names.values() for joint in names}
    if name == "percent":
        _require_motors(declared, joints)
    own_driver = str(declared.info.get("robot_type") or "").startswith(_OWN_DRIVERS)
    converted = sorted(
        joint for joint in joints & set(declared.motors) if name == "percent" or is_gripper(joint)
    )
    if converted:
        notes.add("units", f"per cent of the calibrated range: {list_names(converted)}")
    reversed_motors = [joint for joint in converted if declared.motors[joint].is_reversed]
    if reversed_motors:
        notes.add("units", "drive_mode 1, angles in the direction of the encoder: "
                  + list_names(reversed_motors))  # fmt: skip
    unknown = {joint for joint in joints if is_gripper(joint)} - set(declared.motors)
    if not own_driver or name != "deg":
        return Unit(name, declared.motors)
    if unknown:
        notes.add(
            "units",
            f"left out: {list_names(sorted(unknown))}: LeRobot's drivers record a gripper in per "
            "cent of its range, also where other joints are in degrees; --motor-calibration "
            "FILE.json of the arm (calibration/robots/ in LeRobot's cache) converts it",
        )
    return Unit(name, declared.motors, frozenset(unknown))


def _stated(declared: Declared) -> str | None:
    """The unit that the user or the data set states.

    Raises:
        FormatError: it is none, or differs between joints.
    """
    if declared.asked is not None:
        return _unit_named(declared.asked, declared.file)
    for described in (*declared.features, declared.info):
        if not isinstance(described, dict):
            continue
        unit = described.get("units", described.get("unit"))
        if isinstance(unit, list) and unit and all(one == unit[0] for one in unit):
            unit = unit[0]
        if unit is not None and not isinstance(unit, str):
            raise FormatError(
                "not a unit of joint angles",
                path=declared.file,
                where="units",
                value=str(unit),
                expected="deg or rad, one for all joints",
            )
        if isinstance(unit, str):
            return _unit_named(unit, declared.file)
    return None


def _detected(declared: Declared, positions: Positions, notes: Notes) -> str:
    """The unit by the values.

    Raises:
        FormatError: they may be degrees or per cent.
    """
    largest, body = positions.largest(grippers=True), positions.largest(grippers=False)
    change = "if that is wrong, pass --units rad or --units deg"
    if largest <= _MOST_RADIANS:
        notes.add(
            "units", f"no unit is declared and no value is beyond {largest:.4g}: rad; {change}"
        )
        return "rad"
    if largest <= _PER_CENT + _AT_END:
        if declared.motors and _exceeds_ranges(declared.motors, positions):
            return "percent"
        if body >= _PER_CENT - _AT_END or (declared.motors and body > _MOST_RADIANS):
            raise FormatError(
                "positions may be degrees or per cent of each joint's calibrated range",
                path=declared.file, where="units",
                value=f"none declared, values up to {body:.4g}", expected=_WAY_OUT,
            )  # fmt: skip
    notes.add("units", f"no unit is declared, values reach {largest:.4g}: degrees; {change}")
    robot = str(declared.info.get("robot_type") or "")
    if largest <= _PER_CENT and robot.startswith(_OWN_DRIVERS):
        notes.add(
            "units",
            f"a {robot} may also write per cent of each joint's calibrated range (use_degrees "
            f"off): {_WAY_OUT}",
        )
    return "deg"


def _exceeds_ranges(motors: Mapping[str, MotorRange], positions: Positions) -> bool:
    """Whether a position in degrees would be outside its motor's range."""
    for feature, table in positions.values.items():
        for column, joint in enumerate(positions.names[feature]):
            motor = motors.get(joint)
            finite = table[np.isfinite(table[:, column]), column]
            if motor is None or is_gripper(joint) or not finite.size:
                continue
            if np.abs(finite).max() > 0.5 * motor.radians / DEGREE + _BEYOND:
                return True
    return False


def _require_motors(declared: Declared, joints: set[str]) -> None:
    missing = sorted(joints - set(declared.motors))
    if missing:
        raise FormatError(
            "per cent of a calibrated range that is not known", path=declared.file, where="units",
            value=list_names(missing),
            expected="--motor-calibration FILE.json with these motors (calibration/robots/ in "
            "LeRobot's cache)",
        )  # fmt: skip


def _unit_named(unit: str, file: Path) -> str:
    name = _NAMES.get(unit.strip().lower())
    if name is None:
        raise FormatError(
            "not a unit of joint angles", path=file, where="units", value=unit,
            expected="deg, rad or percent",
        )  # fmt: skip
    return name
