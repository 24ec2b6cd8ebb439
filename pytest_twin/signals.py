"""What the recorded signals are: side of the gear, unit, torque or current, filter, clock."""

from __future__ import annotations

import math
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


@dataclass(frozen=True, slots=True)
class PositionSignal:
    """What the positions of a joint are.

    Attributes:
        side: of the gear on which the encoder sits.
        unit: one of ``ANGLES``.
        source: ``measured`` by an encoder, or ``inferred`` from commands.
        filter, clock, rate: as the robot's maker states them; for the record, rate in Hz.
    """

    side: Side = "output"
    unit: str = "rad"
    source: Source = "measured"
    filter: str = ""
    clock: str = ""
    rate: float | None = None


@dataclass(frozen=True, slots=True)
class EffortSignal:
    """What the efforts of a joint are.

    Attributes:
        quantity: ``torque`` (N*m, or N at a slide) or ``current`` (A, or any count of it).
        side: of the gear.
        constant: N*m per unit of current (N at a slide), None where it is to be identified; only
            of a current.
        signed: False where the amount alone is recorded.
        limit: greatest amount that the drive gives, in the recorded unit.
        source: ``measured``, or ``inferred`` from commands.
        filter, clock, rate: as the robot's maker states them; for the record, rate in Hz.
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
class Shared:
    """The other joint that turns this joint's motor too.

    Attributes:
        joint: the other joint.
        ratio: the motor turns as ``own + ratio * other``, times its gear.
    """

    joint: str
    ratio: float = 1.0


@dataclass(frozen=True, slots=True)
class JointSignals:
    """What is recorded of one joint.

    Attributes:
        gear: turns of the motor for one of the joint, negative where it turns the other way; rad
            of the motor per m at a slide.
        zero: the joint's position where the motor's encoder reads zero, rad or m.
        shared: where the motor turns with another joint too.
    """

    position: PositionSignal = field(default_factory=PositionSignal)
    effort: EffortSignal = field(default_factory=EffortSignal)
    gear: float = 1.0
    zero: float = 0.0
    shared: Shared | None = None


@dataclass(frozen=True, slots=True)
class Signals:
    """What is recorded of the robot.

    Attributes:
        default: of joints that are not named.
        joints: joint -> its own.
        table: as it was written; empty where nobody said anything.
    """

    default: JointSignals = field(default_factory=JointSignals)
    joints: Mapping[str, JointSignals] = field(default_factory=dict)
    table: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def of(self, joint: str) -> JointSignals:
        """What is recorded of a joint."""
        return self.joints.get(joint, self.default)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Signals:
        """Of the table ``signals:`` of a ``twin.yaml``; a joint's own go before the default."""
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
        shared=None
        if shared is None
        else Shared(str(shared["joint"]), float(shared.get("ratio", 1.0))),
    )
