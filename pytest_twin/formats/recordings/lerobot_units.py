"""Determine the unit of a LeRobot data set's joints, from its metadata or its values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import FormatError
from pytest_twin.formats.recording import DEGREE, Notes
from pytest_twin.formats.recordings.lerobot_calibration import COUNT, GRIPPER, MotorRange
from pytest_twin.formats.ros_serialization import Floats
from pytest_twin.words import list_names

_NAMES = {
    "deg": "deg", "degree": "deg", "degrees": "deg",
    "rad": "rad", "radian": "rad", "radians": "rad",
    "percent": "percent",
}  # fmt: skip
# Joints of arms turn at most two turns in each direction.
_MOST_RADIANS = 4.0 * math.pi
# Degrees of two turns; larger values are encoder counts.
_MOST_DEGREES = 720.0
# An episode is in another unit if its reach and its motion differ from those of the others by this
# factor, which is rad to degrees, within a tolerance for motions of different size.
_UNIT_RATIO = 180.0 / math.pi
_UNIT_TOLERANCE = 4.0
_FEWEST_EPISODES = 3
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


class UnitError(FormatError):
    """Positions whose unit must be stated.

    Attributes:
        candidates: units that the values may have.
    """

    candidates: tuple[str, ...] = ()

    @classmethod
    def of(cls, problem: str, candidates: tuple[str, ...], **details: Any) -> UnitError:
        """Return the error with the units that the values may have."""
        error = cls(problem, where="units", **details)
        error.candidates = candidates
        return error


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
        name: ``rad``, ``deg``, ``percent`` or ``counts`` of an encoder.
        motors: motor -> its calibrated range, where one is given.
        unknown: joints in per cent of a range that is not known.
        may_be_percent: whether the values fit per cent of a calibrated range too.
    """

    name: str
    motors: Mapping[str, MotorRange]
    unknown: frozenset[str] = frozenset()
    may_be_percent: bool = False

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
        return {"deg": DEGREE, "counts": COUNT}.get(self.name, 1.0)


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
    stated = _stated(declared)
    name = stated or _detected(declared, positions, notes)
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
    may_be_percent = stated is None and name == "deg" and _may_be_percent(declared, positions)
    if not own_driver or name != "deg":
        return Unit(name, declared.motors, may_be_percent=may_be_percent)
    if unknown:
        notes.add(
            "units",
            f"left out: {list_names(sorted(unknown))}: LeRobot's drivers record a gripper in per "
            "cent of its range, also where other joints are in degrees; --motor-calibration "
            "FILE.json of the arm (calibration/robots/ in LeRobot's cache) converts it",
        )
    return Unit(name, declared.motors, frozenset(unknown), may_be_percent)


def episodes_in_another_unit(positions: Positions, episode: Floats) -> dict[int, float]:
    """Return number of an episode -> ratio of its values to those of the others, if of two units.

    All joints have to reach and to move 57.3 times as far, or as little, as in most episodes.

    Args:
        episode: (n,) number of the episode of each row.
    """
    numbers = np.unique(episode)
    if len(numbers) < _FEWEST_EPISODES:
        return {}
    sizes = np.array([_reach_and_motion(positions, episode == number) for number in numbers])
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = sizes / np.median(sizes, axis=0)
        off = np.abs(np.abs(np.log(ratios)) - math.log(_UNIT_RATIO)) < math.log(_UNIT_TOLERANCE)
    same_way = (ratios > 1.0).all(axis=1) | (ratios < 1.0).all(axis=1)
    return {
        int(number): _UNIT_RATIO if ratio[0] > 1.0 else 1.0 / _UNIT_RATIO
        for number, ratio, is_other in zip(numbers, ratios, off.all(axis=1) & same_way, strict=True)
        if is_other
    }


def _reach_and_motion(positions: Positions, rows: NDArray[np.bool_]) -> tuple[float, float]:
    """Largest absolute value, and motion summed over the joints, without grippers."""
    reach = motion = 0.0
    for feature, table in positions.values.items():
        for column, name in enumerate(positions.names[feature]):
            values = table[rows, column]
            values = values[np.isfinite(values)]
            if values.size and not is_gripper(name):
                reach = max(reach, float(np.abs(values).max()))
                motion += float(np.ptp(values))
    return reach, motion


def _may_be_percent(declared: Declared, positions: Positions) -> bool:
    robot = str(declared.info.get("robot_type") or "")
    return positions.largest(grippers=True) <= _PER_CENT + _AT_END and robot.startswith(
        _OWN_DRIVERS
    )


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
    if body > _MOST_DEGREES:
        raise UnitError.of(
            "positions are beyond two turns in degrees, as encoder counts are", ("counts",),
            path=declared.file, value=f"{body:.6g}",
            expected="degrees, rad or per cent; --units deg if these are degrees",
        )  # fmt: skip
    if 0.0 < body <= _MOST_RADIANS:
        raise UnitError.of(
            "joints and gripper are in different units: joints in rad, or hardly moving in "
            "degrees", ("rad", "deg"), path=declared.file,
            value=f"joints up to {body:.4g}, gripper up to {largest:.4g}",
            expected="--units rad or --units deg",
        )  # fmt: skip
    if largest <= _PER_CENT + _AT_END:
        if declared.motors and _exceeds_ranges(declared.motors, positions):
            return "percent"
        if body >= _PER_CENT - _AT_END or (declared.motors and body > _MOST_RADIANS):
            raise UnitError.of(
                "positions may be degrees or per cent of each joint's calibrated range",
                ("percent", "deg"), path=declared.file,
                value=f"none declared, values up to {body:.4g}", expected=_WAY_OUT,
            )  # fmt: skip
    notes.add("units", f"no unit is declared, values reach {largest:.4g}: degrees; {change}")
    robot = str(declared.info.get("robot_type") or "")
    if _may_be_percent(declared, positions):
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
        raise UnitError.of(
            "per cent of a calibrated range that is not known", ("percent",), path=declared.file,
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
