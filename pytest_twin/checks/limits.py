"""Check hard and soft range, velocity and effort limits: in the model, and under commands."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pytest_twin.checks.base import (
    Check,
    Measure,
    NothingToProposeError,
    Observation,
    Progress,
    Trace,
)
from pytest_twin.checks.fields import (
    EFFORT_UNIT,
    POSITION_UNIT,
    VELOCITY_UNIT,
    known_name,
    quantity,
    spec_error,
    tolerance,
)
from pytest_twin.checks.limits_bench import (
    distances_past_stops,
    highest_speed,
    largest_effort,
    servo_range,
)
from pytest_twin.checks.schemas import any_of, array, mapping, number, quantity_field, table, text
from pytest_twin.dependency import Structure
from pytest_twin.errors import SimulationError
from pytest_twin.golden import Golden
from pytest_twin.realization.joint_limits import drivers_of, model_effort, model_range
from pytest_twin.units import Quantity

if TYPE_CHECKING:
    from pytest_twin.realization import Realization


_DURATION = 0.5  # s
_GIVING_WAY = 0.05  # fraction of the range: a stop that yields further is ineffective
# Fraction of the effort -> (name, title) of a first spec.
_PUSHES = {
    1.0: ("limits", "the stops hold the full effort"),
    0.1: ("limits_tenth", "the stops hold a tenth of the effort"),
    0.01: ("limits_hundredth", "the stops hold a hundredth of the effort"),
    0.0: ("limits_no_push", "the stops give way to a hundredth of the effort, so none is applied"),
}
_RANGE_SCHEMA: Mapping[str, Any] = array(quantity_field(), count=2)
_TOLERANCE = {
    "range": {"hinge": "angle", "slide": "length"},
    "stop": {"hinge": "stop_angle", "slide": "stop_length"},
    "velocity": {"hinge": "angular_velocity", "slide": "linear_velocity"},
    "effort": {"hinge": "torque", "slide": "force"},
}


class Limits(Check):
    """Limits of each joint, and their effect on commands beyond them.

    - ``hard``: the range equals the model's; pushed against each stop with its effort, the joint
    does not exceed it by more than ``stop_angle`` or ``stop_length``.
    - ``soft``: is inside the hard range; a position servo commanded far beyond it has its bounds
    as setpoint.
    - ``velocity``: equals the limit of the model's source; if the source has none, the joint
    under its strongest command stays below it.
    - ``effort``: equals the model's limit; the strongest command on the held joint stays below it.

    The tested joint moves without gravity and contact; all joints not coupled to it are held.
    """

    kind: ClassVar[str] = "limits"
    tolerances: ClassVar[Mapping[str, str]] = {
        "angle": "rad",
        "length": "m",
        "stop_angle": "rad",
        "stop_length": "m",
        "angular_velocity": "rad/s",
        "linear_velocity": "m/s",
        "torque": "N*m",
        "force": "N",
    }
    schema: ClassVar[Mapping[str, Any]] = {
        "target": table(
            {
                "joints": mapping(
                    table(
                        {
                            "hard": any_of(
                                {"const": "none"},
                                _RANGE_SCHEMA,
                                description="Lower and upper stop, rad or m; 'none' without stops.",
                            ),
                            "soft": {
                                **_RANGE_SCHEMA,
                                "description": "Lower and upper limit of commanded positions, rad "
                                "or m.",
                            },
                            "velocity": quantity_field("Largest speed, such as '180 deg/s'."),
                            "effort": quantity_field("Largest torque or force, such as '10 N*m'."),
                        },
                        minProperties=1,
                    ),
                    "Joint -> its declared limits.",
                    minProperties=1,
                )
            },
            required=["joints"],
        ),
        "stimulus": table(
            {
                "duration": text(
                    "Time for which each command or push is applied. Default: '500 ms'."
                ),
                "push": number(
                    "Fraction of the joint's effort with which it is pushed against its stops. "
                    "Default: 1. 0: no push.",
                    minimum=0,
                    maximum=1,
                ),
            }
        ),
    }

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Return all parts that affect the joints' motion: ranges, actuators and inertia."""
        joints = golden.target["joints"]
        return structure.dynamics(joints) | structure.limits(joints)

    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Read every limit of the model, then command and push each joint beyond it."""
        kinds = {
            joint: kind
            for joint, kind in realization.structure.joint_type.items()
            if kind in POSITION_UNIT
        }
        duration = quantity(
            golden, "stimulus.duration", golden.stimulus.get("duration", _DURATION), "s"
        )
        joints = golden.target["joints"]
        found: dict[str, dict[str, Any]] = {}
        for joint_index, joint in enumerate(joints):
            place = f"target.joints.{joint}"
            known_name(golden, place, joint, kinds, "hinge or slide joint")
            declared = _declaration(golden, joint, kinds[joint])
            found[joint] = {"type": kinds[joint]} | _observed_limits(
                realization, joint, declared, duration, float(golden.stimulus.get("push", 1.0))
            )
            progress((joint_index + 1) / len(joints))
        return Observation({"joints": found})

    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Compare every declared limit with the model's and with the result of the push."""
        measures: list[Measure] = []
        for joint, found in observation.values["joints"].items():
            declared = _declaration(golden, joint, found["type"])
            measures.extend(_compare_range(golden, joint, declared, found))
            measures.extend(_compare_effort(golden, joint, declared, found))
            measures.extend(_compare_velocity(golden, joint, declared, found))
        return measures

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose every limit that the model or its source states.

        Stops that yield to the full effort by more than a twentieth of the range are pushed with a
        tenth or a hundredth of it, or not at all, each in a separate spec.
        """
        structure = realization.structure
        groups: dict[float, dict[str, Any]] = {fraction: {} for fraction in _PUSHES}
        for joint in realization.joints:
            if structure.joint_type.get(joint) in POSITION_UNIT and (
                entry := _stated_limits(realization, joint)
            ):
                groups[self._holding(realization, joint, entry)][joint] = entry
        if not any(groups.values()):
            raise NothingToProposeError("no joint with a name states a limit")
        specs: list[Mapping[str, Any]] = []
        for fraction, joints in groups.items():
            if not joints:
                continue
            stimulus: dict[str, Any] = {} if fraction == 1.0 else {"push": fraction}
            specs.append(
                {
                    "name": _PUSHES[fraction][0],
                    "title": f"Ranges, speeds and efforts; {_PUSHES[fraction][1]}",
                    "target": {"joints": joints},
                    "stimulus": stimulus,
                    "tolerance": self._bounds(realization, joints, stimulus),
                }
            )
        return specs

    def _holding(self, realization: Realization, joint: str, entry: Mapping[str, Any]) -> float:
        """Return the largest fraction of its effort that a joint's stops withstand."""
        if not isinstance(entry["hard"], list):
            return 1.0
        lower, upper = entry["hard"]
        for fraction in _PUSHES:
            draft = self._draft(realization, {joint: entry}, {"push": fraction})
            try:
                found = self.observe(draft, realization, lambda done: None)
            except SimulationError:
                continue
            passed = found.values["joints"][joint].get("stop", [0.0])
            if max(passed) <= _GIVING_WAY * (upper - lower):
                return fraction
        return 0.0

    def _bounds(
        self, realization: Realization, joints: Mapping[str, Any], stimulus: Mapping[str, Any]
    ) -> dict[str, str]:
        draft = self._draft(realization, joints, stimulus)
        measures = self.compare(draft, self.observe(draft, realization, lambda done: None), None)
        bounds = {}
        for name, unit in self.tolerances.items():
            errors = [measure.error for measure in measures if measure.name == name]
            if errors:
                # 1.5 times the deflection of the model's stops, two digits.
                least = 1e-4 if name in _TOLERANCE["stop"].values() else 1e-6
                bounds[name] = f"{_round_up(max(1.5 * max(errors), least)):g} {unit}"
        return bounds

    def _draft(
        self, realization: Realization, joints: Mapping[str, Any], stimulus: Mapping[str, Any]
    ) -> Golden:
        return Golden(
            id=self.kind,
            path=Path(f"{self.kind}.yaml"),
            kind=self.kind,
            title="",
            realizations=(realization.name,),
            criticality="critical",
            target={"joints": joints},
            stimulus=stimulus,
            tolerance={name: Quantity(math.inf, unit) for name, unit in self.tolerances.items()},
        )


@dataclass(frozen=True, slots=True)
class _Declared:
    """Declared limits of one joint, SI units; ``hard`` is False if the spec states 'none'."""

    hard: tuple[float, float] | bool | None
    soft: tuple[float, float] | None
    velocity: float | None
    effort: float | None


def _declaration(golden: Golden, joint: str, kind: str) -> _Declared:
    place = f"target.joints.{joint}"
    entry = golden.target["joints"][joint]

    def number(name: str, unit: str) -> float | None:
        if name not in entry:
            return None
        value = quantity(golden, f"{place}.{name}", entry[name], unit)
        if not value > 0.0:
            raise spec_error(
                golden, f"{place}.{name}", "not a limit", value=entry[name], expected="above zero"
            )
        return value

    def bounds(name: str) -> tuple[float, float] | None:
        if name not in entry:
            return None
        lower, upper = (
            quantity(golden, f"{place}.{name}", value, POSITION_UNIT[kind]) for value in entry[name]
        )
        if not lower < upper:
            raise spec_error(
                golden, f"{place}.{name}", "not a range", value=entry[name], expected="lower, upper"
            )
        return lower, upper

    return _Declared(
        hard=False if entry.get("hard") == "none" else bounds("hard"),
        soft=bounds("soft"),
        velocity=number("velocity", VELOCITY_UNIT[kind]),
        effort=number("effort", EFFORT_UNIT[kind]),
    )


# -- what the model states


def _stated_limits(realization: Realization, joint: str) -> dict[str, Any]:
    """Return a declaration of one joint from the model and its source."""
    model = realization.model
    entry: dict[str, Any] = {}
    hard = model_range(model, realization.joint_index(joint))
    entry["hard"] = hard if hard is not None else "none"
    soft = servo_range(realization, joint)
    if soft is not None and hard is not None and soft[0] < soft[1]:
        slack = 1e-3 * (hard[1] - hard[0])
        if hard[0] - slack <= soft[0] and soft[1] <= hard[1] + slack:
            entry["soft"] = soft
    velocity = realization.velocity_limit.get(joint)
    if velocity is not None and 0.0 < velocity < math.inf:
        entry["velocity"] = velocity
    effort = model_effort(realization, joint)
    if effort is not None and effort[1] > 0.0 and math.isclose(-effort[0], effort[1]):
        entry["effort"] = effort[1]
    return {} if entry == {"hard": "none"} else entry


# -- what commands and pushes reach


def _observed_limits(
    realization: Realization,
    joint: str,
    declared: _Declared,
    duration: float,
    fraction: float,
) -> dict[str, Any]:
    model = realization.model
    found: dict[str, Any] = {"range": model_range(model, realization.joint_index(joint))}
    if declared.soft is not None:
        found["aim"] = servo_range(realization, joint)
    limit = model_effort(realization, joint)
    reached = None
    drivers = drivers_of(realization, joint)
    if drivers and (declared.effort is not None or declared.hard):
        reached = largest_effort(realization, joint, drivers, duration)
    if declared.effort is not None:
        found["effort_limit"], found["effort_reached"] = limit, reached
    if declared.velocity is not None:
        stated = realization.velocity_limit.get(joint)
        found["velocity_limit"] = stated
        if stated is None and drivers:
            found["velocity_reached"] = highest_speed(realization, joint, drivers, duration)
    if declared.hard and found["range"] is not None and fraction > 0.0:
        push = declared.effort
        if push is None and limit is not None:
            push = max(abs(end) for end in limit)
        elif push is None and reached is not None:
            push = max(abs(end) for end in reached)
        if push is not None:
            found["stop"] = distances_past_stops(
                realization, joint, found["range"], fraction * push, duration
            )
    return found


# -- verdicts


def _measure(
    golden: Golden,
    family: str,
    kind: str,
    subject: str,
    measured: float,
    bound: float,
    error: float,
) -> Measure:
    name = _TOLERANCE[family][kind]
    allowed = tolerance(golden, name, f"{subject} is compared with it")
    return Measure(name, subject, measured, bound, error, allowed.value, allowed.unit, "declared")


def _compare_range(
    golden: Golden, joint: str, declared: _Declared, found: Mapping[str, Any]
) -> list[Measure]:
    kind, model_range = found["type"], found["range"]
    measures = []
    if declared.hard is False:
        limited = 0.0 if model_range is None else math.inf
        measures.append(_measure(golden, "range", kind, f"{joint}: no stop", limited, 0.0, limited))
    elif isinstance(declared.hard, tuple):
        actual = (-math.inf, math.inf) if model_range is None else model_range
        for side, end, was in zip(("lower", "upper"), actual, declared.hard, strict=True):
            measures.append(
                _measure(golden, "range", kind, f"{joint}: {side} stop", end, was, abs(end - was))
            )
        for side, passed in zip(("lower", "upper"), found.get("stop", ()), strict=False):
            subject = f"{joint}: pushed past the {side} stop"
            measures.append(_measure(golden, "stop", kind, subject, passed, 0.0, passed))
    if declared.soft is None:
        return measures
    if isinstance(declared.hard, tuple):
        for side, sign, soft, hard in zip(
            ("lower", "upper"), (-1.0, 1.0), declared.soft, declared.hard, strict=True
        ):
            error = max(0.0, sign * (soft - hard))
            subject = f"{joint}: {side} soft bound, inside the stop"
            measures.append(_measure(golden, "range", kind, subject, soft, hard, error))
    if found["aim"] is not None:
        for side, aim, soft in zip(("lower", "upper"), found["aim"], declared.soft, strict=True):
            subject = f"{joint}: commanded past the {side} soft bound"
            measures.append(_measure(golden, "range", kind, subject, aim, soft, abs(aim - soft)))
    return measures


def _compare_effort(
    golden: Golden, joint: str, declared: _Declared, found: Mapping[str, Any]
) -> list[Measure]:
    if declared.effort is None:
        return []
    bound, kind = declared.effort, found["type"]
    limit, reached = found["effort_limit"], found["effort_reached"]
    measures = []
    if limit is not None:
        for side, end, sign in zip(("negative", "positive"), limit, (-1.0, 1.0), strict=True):
            error = abs(end - sign * bound)
            subject = f"{joint}: {side} effort limit"
            measures.append(_measure(golden, "effort", kind, subject, end, sign * bound, error))
    if reached is not None:
        for side, end, sign in zip(("negative", "positive"), reached, (-1.0, 1.0), strict=True):
            # A model without an effort limit must saturate at the declared effort.
            error = abs(end) - bound
            error = max(0.0, error) if limit is not None else abs(error)
            subject = f"{joint}: {side} effort, commanded past"
            measures.append(_measure(golden, "effort", kind, subject, end, sign * bound, error))
    if not measures:
        subject = f"{joint}: effort limit, which the model lacks"
        measures.append(_measure(golden, "effort", kind, subject, math.inf, bound, math.inf))
    return measures


def _compare_velocity(
    golden: Golden, joint: str, declared: _Declared, found: Mapping[str, Any]
) -> list[Measure]:
    if declared.velocity is None:
        return []
    bound, stated = declared.velocity, found["velocity_limit"]
    if stated is not None:
        subject, speed, error = f"{joint}: velocity limit", stated, abs(stated - bound)
    elif "velocity_reached" in found:
        speed = found["velocity_reached"]
        subject, error = f"{joint}: speed, commanded past", max(0.0, speed - bound)
    else:
        subject = f"{joint}: velocity limit, which the model lacks"
        speed = error = math.inf
    return [_measure(golden, "velocity", found["type"], subject, speed, bound, error)]


def _round_up(value: float) -> float:
    """Round to two digits, never below ``value``."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / step - 1e-9) * step
