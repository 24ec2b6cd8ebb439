"""Inject six faults in simulation; a residual must fall back to the base model in each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pytest_twin.adaptation.guard import Guard, Sample
from pytest_twin.adaptation.guarded_simulation import Distort, Log, simulate
from pytest_twin.adaptation_spec import ResidualSpec
from pytest_twin.arrays import FloatArray
from pytest_twin.open_loop import Row

_WINDOW_HOLD_OFFS = 4.0
"""Duration of a fault in multiples of the hold-off time, so that fallback and hold-off are both
visible."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault and the required reaction.

    Attributes:
        name: name in the report.
        distort: function from (start, end, spec) to the change of the sensor samples.
        is_permanent: whether the residual must stay off until the end; else for one hold-off time.
        grace: function from the spec to the time after the start, s, in which it may still act.
        is_impulse: whether the joints get an impact at the start.
    """

    name: str
    distort: Callable[[float, float, ResidualSpec], Distort] | None
    is_permanent: bool = True
    grace: Callable[[ResidualSpec], float] = lambda spec: 0.0
    is_impulse: bool = False


def _apply_within(start: float, end: float, change: Callable[[Sample], Sample | None]) -> Distort:
    return lambda time, sample, guard: change(sample) if start <= time < end else sample


def _shift(start: float, end: float, spec: ResidualSpec) -> Distort:
    """Shift positions out of the valid region, by its width."""
    width = np.array([r.position[1] - r.position[0] for r in spec.joints.values()])
    return _apply_within(start, end, lambda s: replace(s, position=s.position + width))


def _dropout(start: float, end: float, spec: ResidualSpec) -> Distort:
    return _apply_within(
        start, end, lambda s: replace(s, velocity=np.full_like(s.velocity, np.nan))
    )


def _stale(start: float, end: float, spec: ResidualSpec) -> Distort:
    """Repeat the last message of the sensors."""
    last: list[Sample] = []

    def distort(time: float, sample: Sample, guard: Guard) -> Sample:
        if not start <= time < end:
            return sample
        if not last:
            last.append(sample)
        return last[0]

    return distort


def _restart(start: float, end: float, spec: ResidualSpec) -> Distort:
    done: list[bool] = []

    def distort(time: float, sample: Sample, guard: Guard) -> Sample:
        if time >= start and not done:
            done.append(True)
            guard.restart()
        return sample

    return distort


FAULTS = (
    Fault("distribution_shift", _shift),
    Fault("sensor_dropout", _dropout),
    Fault("stale_time", _stale, grace=lambda spec: spec.max_age + spec.period),
    Fault("saturation", None, grace=lambda spec: spec.hold_off + spec.period),
    Fault("contact_transition", None, is_permanent=False, is_impulse=True),
    Fault("restart", _restart, is_permanent=False),
)


def inject(spec: ResidualSpec, law: Any, row: Row, undisturbed: Log) -> list[dict[str, Any]]:
    """Simulate a residual under each fault, and check the fallback.

    The fault starts where the undisturbed residual acts longest without interruption. The check
    passes if the force never exceeds its bound, is zero where required, and the simulation stays
    finite.

    Args:
        spec, law: declaration and function of the residual.
        row: trial to disturb, with the base model.
        undisturbed: log of the residual in this trial without a fault.
    """
    span = _window(undisturbed, spec, row.trial.duration)
    if span is None:
        why = "the residual never acts long enough in these recordings"
        return [{"fault": fault.name, "holds": False, "why": why} for fault in FAULTS]
    return [_injection_result(fault, spec, law, row, *span) for fault in FAULTS]


def _window(log: Log, spec: ResidualSpec, duration: float) -> tuple[float, float] | None:
    """Start and end (s) of a fault inside the longest interval in which the residual acts."""
    time, force = log.table
    acts = np.concatenate([[False], np.any(force != 0.0, axis=1), [False]])
    edges = np.flatnonzero(np.diff(acts.astype(int)))
    if not len(edges):
        return None
    begins, ends = edges[::2], edges[1::2] - 1
    longest = int(np.argmax(time[ends] - time[begins]))
    start = float(time[begins[longest]]) + spec.hold_off
    end = min(start + _WINDOW_HOLD_OFFS * spec.hold_off, duration - 2.0 * spec.hold_off)
    usable = end - start > 2.0 * spec.hold_off and start < time[ends[longest]]
    return (start, end) if usable else None


def _injection_result(
    fault: Fault, spec: ResidualSpec, law: Any, row: Row, start: float, end: float
) -> dict[str, Any]:
    guard = Guard(spec, law)
    distort = None if fault.distort is None else fault.distort(start, end, spec)
    if fault.name == "saturation":
        distort = _louder(start, end, law, guard)
    jump = np.array([region.jump for region in spec.joints.values()])
    kick = (start, 2.0 * jump) if fault.is_impulse else None
    replayed, log = simulate(row, guard, distort=distort, kick=kick)
    time, force = log.table
    from_, until = start + fault.grace(spec), end + spec.hold_off
    if not fault.is_permanent:
        until = start + spec.hold_off
    # The first sample with the fault is the one at its start, or the next one for an impact.
    out = (time >= from_ + spec.period - 1e-9) & (time < until - 1e-9)
    bounded = bool((np.abs(force) <= guard.bound + 1e-12).all())
    finite = replayed.error is None and bool(np.isfinite(replayed.position).all())
    left = float(np.abs(force[out]).max(initial=0.0))
    after = time >= until + spec.period
    problems = []
    if not bounded:
        problems.append("the force exceeds its bound")
    if left > 0.0:
        problems.append(f"a force of {left:.3g} where the base alone has to act")
    if not finite:
        problems.append("the simulation diverges")
    return {
        "fault": fault.name,
        "start": start,
        "end": end if fault.is_permanent else start,
        "holds": not problems,
        "why": "; ".join(problems) or "the base alone acts while it has to",
        "largest_force": [float(value) for value in np.abs(force).max(axis=0)],
        "acts_again": bool(np.any(force[after] != 0.0)),
    }


def _louder(start: float, end: float, law: Any, guard: Guard) -> Distort:
    """Make the residual request a million times its force, far above its bound."""

    def loud(
        position: FloatArray, velocity: FloatArray, command: FloatArray
    ) -> tuple[FloatArray, FloatArray | None]:
        force, deviation = law(position, velocity, command)
        return np.where(force < 0.0, -1e6, 1e6) * guard.bound, deviation

    def distort(time: float, sample: Sample, guard: Guard) -> Sample:
        guard.law = loud if start <= time < end else law
        return sample

    return distort
