"""Meaning of recorded signals: side of the gear, unit, torque or current, filter, clock."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Side = Literal["output", "motor"]
Quantity = Literal["torque", "current"]
Source = Literal["measured", "inferred"]

ANGLES: Mapping[str, float] = {
    "rad": 1.0,
    "deg": math.pi / 180.0,
    "turn": 2.0 * math.pi,
    "m": 1.0,
    "mm": 1e-3,
}
"""Unit of a position -> factor to rad or m."""
_FREQUENCY = re.compile(r"(?<![\w.])(\d+(?:\.\d+)?)\s*(k?)Hz\b")
"""A frequency in the text of a filter."""


@dataclass(frozen=True, slots=True)
class PositionSignal:
    """Meaning of a joint's recorded positions.

    Attributes:
        side: side of the gear on which the encoder is mounted.
        unit: one of ``ANGLES``.
        source: ``measured`` by an encoder, or ``inferred`` from commands.
        filter: low-pass of the signal as the manufacturer states it. A frequency in it, such as
            ``"20 Hz"``, is the cutoff at which an identification filters the motion.
        clock, rate: as the manufacturer states them, rate in Hz; stored, not used.
        wrapped: whether the values of a revolute joint stay within one turn, such as -pi to pi;
            None where the values decide.
    """

    side: Side = "output"
    unit: str = "rad"
    source: Source = "measured"
    filter: str = ""
    clock: str = ""
    rate: float | None = None
    wrapped: bool | None = None


@dataclass(frozen=True, slots=True)
class EffortSignal:
    """Meaning of a joint's recorded efforts.

    Attributes:
        quantity: ``torque`` (N*m, or N at a slide) or ``current`` (A, or raw counts).
        side: side of the gear on which it acts.
        constant: torque constant, N*m per unit of current (N at a slide); None where it is to be
            identified. For a current only.
        signed: False where only the magnitude is recorded.
        limit: largest magnitude of the drive, in the recorded unit.
        source: ``measured``, or ``inferred`` from commands.
        filter: low-pass of the signal as the manufacturer states it. A frequency in it, such as
            ``"20 Hz"``, is the cutoff at which an identification filters the motion.
        clock, rate: as the manufacturer states them, rate in Hz; stored, not used.
    """

    quantity: Quantity = "torque"
    side: Side = "output"
    constant: float | None = None
    signed: bool = True
    limit: float | None = None
    source: Source = "measured"
    filter: str = ""
    clock: str = ""
    rate: float | None = None


@dataclass(frozen=True, slots=True)
class CoupledJoint:
    """Kinematic coupling: a second joint also turns this joint's motor.

    Attributes:
        ratio: the motor turns by ``gear * (own + ratio * other)``.
    """

    joint: str
    ratio: float = 1.0


@dataclass(frozen=True, slots=True)
class JointSignals:
    """Meaning of the recorded signals of one joint.

    Attributes:
        gear: gear ratio, turns of the motor per turn of the joint (rad of the motor per m at a
            slide); negative where they turn in opposite directions.
        zero: position of the joint where the motor's encoder reads zero, rad or m.
        shared: the coupling with another joint, or None.
        checked: whether a person checked sign, unit, side and gear: a suspected mistake of them is
            reported, and rejects nothing.
    """

    position: PositionSignal = field(default_factory=PositionSignal)
    effort: EffortSignal = field(default_factory=EffortSignal)
    gear: float = 1.0
    zero: float = 0.0
    shared: CoupledJoint | None = None
    checked: bool = False

    @property
    def filter_cutoff(self) -> float | None:
        """Lowest cutoff, Hz, that the filters of position and effort state; None without one."""
        stated = [
            float(number) * (1e3 if prefix else 1.0)
            for text in (self.position.filter, self.effort.filter)
            for number, prefix in _FREQUENCY.findall(text)
        ]
        return min((cutoff for cutoff in stated if cutoff > 0.0), default=None)


@dataclass(frozen=True, slots=True)
class Signals:
    """Meaning of the recorded signals of a robot.

    Attributes:
        default: signals of joints that ``joints`` does not name.
        joints: joint -> its signals.
        table: the section as written; empty without a declaration.
    """

    default: JointSignals = field(default_factory=JointSignals)
    joints: Mapping[str, JointSignals] = field(default_factory=dict)
    table: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def of(self, joint: str) -> JointSignals:
        """The signals of a joint, or the default."""
        return self.joints.get(joint, self.default)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Signals:
        """Build the signals from the table ``signals:`` of a ``twin.yaml``.

        The values of a joint override the default.
        """
        if not data:
            return cls()
        default = data.get("default", {})
        return cls(
            _joint(default, {}),
            {name: _joint(own or {}, default) for name, own in data.get("joints", {}).items()},
            table=data,
        )


NO_SIGNALS = Signals()


def _joint(own: Mapping[str, Any], default: Mapping[str, Any]) -> JointSignals:
    merged = {**default, **own}
    shared = merged.get("shared_with")
    return JointSignals(
        position=PositionSignal(**{**default.get("position", {}), **own.get("position", {})}),
        effort=EffortSignal(**{**default.get("effort", {}), **own.get("effort", {})}),
        gear=float(merged.get("gear", 1.0)),
        zero=float(merged.get("zero", 0.0)),
        checked=bool(merged.get("checked", False)),
        shared=None
        if shared is None
        else CoupledJoint(str(shared["joint"]), float(shared.get("ratio", 1.0))),
    )
