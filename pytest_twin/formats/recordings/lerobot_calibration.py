"""Read a motor calibration of LeRobot, and convert its per cent of range to angles.

LeRobot keeps one JSON file for each arm, with encoder counts for each motor, under
``calibration/robots/TYPE/NAME.json`` of its cache. Positions are recorded in one of three ways:
degrees from the middle of the range, -100 to 100 over the range, and 0 to 100 over the range, which
is always used for a gripper. https://github.com/huggingface/lerobot, ``motors/motors_bus.py``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pytest_twin.errors import FormatError
from pytest_twin.formats import limits
from pytest_twin.formats.paths import decode_text, read_bytes
from pytest_twin.formats.ros_serialization import Floats

GRIPPER = "gripper"
_KEYS = ("id", "drive_mode", "homing_offset", "range_min", "range_max")
# Counts of one turn less one, as LeRobot scales degrees, of the motors of its arms.
_TURN_COUNTS = 4095
COUNT = 2.0 * math.pi / _TURN_COUNTS
"""rad of one encoder count, as LeRobot scales it."""
_OLD_KEYS = {"motor_names", "calib_mode", "start_pos"}
_PER_CENT = 100.0


@dataclass(frozen=True)
class MotorRange:
    """Range of one motor.

    Attributes:
        lowest, highest: encoder counts at the ends of its range.
        is_reversed: whether per cent grow against the direction of the encoder (``drive_mode``).
    """

    lowest: int
    highest: int
    is_reversed: bool

    @property
    def radians(self) -> float:
        """Angle between the ends of the range, rad."""
        return (self.highest - self.lowest) * COUNT

    def angles(self, per_cent: Floats, *, from_closed: bool) -> Floats:
        """Return angles (rad) of positions in per cent.

        They are in the direction of the encoder, as LeRobot's degrees are.

        Args:
            per_cent: -100 to 100 from the middle of the range, or 0 to 100 from its lower end.
            from_closed: whether they are from the lower end; the angles are too.
        """
        if from_closed:
            share = (_PER_CENT - per_cent if self.is_reversed else per_cent) / _PER_CENT
        else:
            share = (-per_cent if self.is_reversed else per_cent) / (2.0 * _PER_CENT)
        angles: Floats = share * self.radians
        return angles


def read_calibration(path: Path) -> Mapping[str, MotorRange]:
    """Return motor -> its range.

    Raises:
        FormatError: not JSON, of an older LeRobot, or with a motor that lacks a range.
    """
    text = decode_text(read_bytes(path, limits.YAML.file_bytes), path)
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"not JSON: {str(error)[:80]}", path=path) from None
    expected = "motor names, each with " + ", ".join(_KEYS)
    if not isinstance(document, dict) or not document:
        raise FormatError("not a motor calibration of LeRobot", path=path, expected=expected)
    if _OLD_KEYS & set(document):
        raise FormatError(
            "a motor calibration of LeRobot before 2025", path=path,
            expected="no calibration: such arms record degrees, --units deg",
        )  # fmt: skip
    return {str(motor): _range_of(str(motor), entry, path) for motor, entry in document.items()}


def _range_of(motor: str, entry: object, path: Path) -> MotorRange:
    values = [entry.get(key) if isinstance(entry, dict) else None for key in _KEYS]
    for key, value in zip(_KEYS, values, strict=True):
        if type(value) is not int:
            raise FormatError(
                "not a motor calibration of LeRobot", path=path, where=f"{motor[:80]}.{key}",
                value=str(value)[:80], expected="a whole number",
            )  # fmt: skip
    lowest, highest = int(values[3] or 0), int(values[4] or 0)
    if not 0 <= lowest < highest <= _TURN_COUNTS:
        raise FormatError(
            "not the range of a motor of 4096 counts a turn", path=path, where=motor[:80],
            value=f"range_min {lowest}, range_max {highest}",
            expected=f"0 <= range_min < range_max <= {_TURN_COUNTS}",
        )  # fmt: skip
    return MotorRange(lowest, highest, is_reversed=bool(values[1]))
