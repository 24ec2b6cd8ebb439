"""Six faults that a residual must survive by falling back to the base, injected in simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pytest_twin.adaptation.guard import Guard, Sample
from pytest_twin.adaptation.simulated import Distort, Log, simulate
from pytest_twin.adaptation_spec import ResidualSpec
from pytest_twin.arrays import FloatArray
from pytest_twin.replay import Row

_WINDOW_HOLD_OFFS = 4.0
"""Length of a fault in multiples of the hold-off, so that falling back and waiting both show."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault and what has to follow.

    Attributes:
        name: as reported.
        distort: of (start, end, spec) what the sensors do.
        is_permanent: whether the residual has to stay out until the end; else for one hold-off.
        grace: of the spec, s after the start in which it may still act.
        is_impulse: whether the joints are hit at the start.
    """

    name: str
    distort: Callable[[float, float, ResidualSpec], Distort] | None
    is_permanent: bool = True
    grace: Callable[[ResidualSpec], float] = lambda spec: 0.0
    is_impulse: bool = False


def _within(start: float, end: float, change: Callable[[Sample], Sample | None]) -> Distort:
    return lambda time, sample, guard: change(sample) if start <= time < end else sample


def _shift(start: float, end: float, spec: ResidualSpec) -> Distort:
    """Positions that no data have shown: by the width of the valid region."""
    width = np.array([r.position[1] - r.position[0] for r in spec.joints.values()])
    return _within(start, end, lambda s: replace(s, position=s.position + width))


def _dropout(start: float, end: float, spec: ResidualSpec) -> Distort:
    return _within(start, end, lambda s: replace(s, velocity=np.full_like(s.velocity, np.nan)))


def _stale(start: float, end: float, spec: ResidualSpec) -> Distort:
    """The sensors' last message again and again."""
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
    """What a residual does under each fault, and whether the fallback holds.

    The fault starts where the undisturbed residual acts longest without a break. It holds where
    the force never exceeds its bound, is zero while it has to be, and the simulation stays finite.

    Args:
        spec, law: the residual.
        row: the trial to disturb, with the base model.
        undisturbed: what the residual did in it without a fault.
    """
    span = _window(undisturbed, spec, row.trial.duration)
    if span is None:
        why = "the residual never acts long enough in these recordings"
        return [{"fault": fault.name, "holds": False, "why": why} for fault in FAULTS]
    return [_injected(fault, spec, law, row, *span) for fault in FAULTS]


def _window(log: Log, spec: ResidualSpec, duration: float) -> tuple[float, float] | None:
    """Start and end (s) of a fault inside the longest stretch in which the residual acts."""
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


def _injected(
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
    # The sample at the start of a fault is the first that shows it, the one after it for a kick.
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
    """A residual that asks for a million times its force, at least that many bounds."""

    def loud(
        position: FloatArray, velocity: FloatArray, command: FloatArray
    ) -> tuple[FloatArray, FloatArray | None]:
        force, deviation = law(position, velocity, command)
        return np.where(force < 0.0, -1e6, 1e6) * guard.bound, deviation

    def distort(time: float, sample: Sample, guard: Guard) -> Sample:
        guard.law = loud if start <= time < end else law
        return sample

    return distort
