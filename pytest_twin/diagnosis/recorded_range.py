"""Range of shape parameters that the recordings can identify.

Examples outside it: a warm-up of minutes in recordings of seconds, a Stribeck velocity above the
largest speed, a ripple shorter than the distance between samples. A fit that ends there compensates
for another effect, so findings must be inside the range.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.trial_settings import RANGES
from pytest_twin.effects.base import Parameter
from pytest_twin.estimation.hypothesis import Hypothesis, Term


@dataclass(frozen=True, slots=True)
class RecordedRange:
    """Ranges of time, speed and position in the recordings.

    Attributes:
        duration: duration of the longest recording, s.
        speeds: for each joint, (samples,) absolute speeds in ascending order, rad/s or m/s.
        step: (joints,) distance between two samples while a joint moves slowly, rad or m.
        travel: (joints,) range of the positions, rad or m.
        noise: (joints,) noise floor, rad or m.
        has_different_temperatures: whether the recorded temperatures differ.
    """

    duration: float
    speeds: tuple[FloatArray, ...]
    step: FloatArray
    travel: FloatArray
    noise: FloatArray
    has_different_temperatures: bool

    @classmethod
    def of(cls, problem: Problem) -> RecordedRange:
        """Ranges of the positions of all segments of a problem."""
        segments = problem.simulator.segments
        joints = len(problem.joints)
        last: dict[int, float] = {}
        for s in segments:
            last[s.trial] = max(last.get(s.trial, 0.0), float(s.time[-1]))
        steps = [np.abs(np.diff(s.position, axis=0)) for s in segments]
        times = [np.maximum(np.diff(s.time), 1e-9)[:, None] for s in segments]
        step = np.concatenate([*steps, np.zeros((1, joints))])
        speed = np.concatenate(
            [*(d / t for d, t in zip(steps, times, strict=True)), np.zeros((1, joints))]
        )
        position = np.concatenate([s.position for s in segments])
        fine = np.zeros(joints)
        for j in range(joints):
            moving = speed[:, j] > RANGES.moving_share * speed[:, j].max()
            fine[j] = (
                np.quantile(step[moving, j], RANGES.distance_quantile) if moving.any() else 0.0
            )
        return cls(
            max(last.values()),
            tuple(np.sort(speed[:, j]) for j in range(joints)),
            fine,
            np.ptp(position, axis=0),
            problem.floor,
            problem.has_different_temperatures,
        )

    def why_not_identifiable(self, term: Term, parameter: Parameter, value: float) -> str:
        """Reason why a shape parameter is not identifiable at this SI value; empty if it is."""
        if parameter.neutral is not None or parameter.reference == "twelfth":
            return ""
        j = max(term.joint, 0)
        name = parameter.name.replace("_", " ")
        if parameter.quantity == "time":
            by_temperature = term.law.needs_temperature and self.has_different_temperatures
            if value > RANGES.longest_constant * self.duration and not by_temperature:
                return f"a {name} of {value:.3g} s, in recordings of at most {self.duration:.3g} s"
        elif parameter.quantity == "velocity":
            fastest = float(self.speeds[j][-1])
            if value > fastest:
                return f"a {name} of {value:.3g}, above the greatest speed ({fastest:.3g})"
            below = np.searchsorted(self.speeds[j], value)
            if len(self.speeds[j]) - below < RANGES.fewest_samples:
                return f"a {name} of {value:.3g}, below which nearly all samples lie"
        elif parameter.quantity == "wavenumber":
            if value * self.step[j] > np.pi:
                return (
                    f"{value:.3g} periods a turn: samples are {self.step[j]:.3g} rad apart, more "
                    "than half a period"
                )
        elif parameter.quantity == "position" and value > self.travel[j] > 0.0:
            return f"a {name} of {value:.3g}, more than the travel of {self.travel[j]:.3g}"
        return ""


def unidentifiable_effects(
    problem: Problem, hypothesis: Hypothesis, recorded: RecordedRange | None = None
) -> dict[Term, str]:
    """Effects whose shape parameters are outside the identifiable range, and the reason of each.

    Args:
        hypothesis: effects with parameters.
        recorded: ranges of the recordings; computed from the problem by default.
    """
    recorded = RecordedRange.of(problem) if recorded is None else recorded
    out: dict[Term, str] = {}
    for term in hypothesis.terms:
        theta = hypothesis.theta[hypothesis.slice_of(term)]
        why = why_unidentifiable(problem, recorded, term, theta)
        if why:
            out[term] = why
    return out


def why_unidentifiable(
    problem: Problem, recorded: RecordedRange, term: Term, theta: FloatArray
) -> str:
    """Reason why an effect is not identifiable at these scaled parameters; empty if it is."""
    has = term.law.has(theta)
    for k, p in enumerate(term.parameters):
        if not has[k]:
            continue
        why = recorded.why_not_identifiable(
            term, p, float(theta[k]) * problem.scales.value(p, term.joint)
        )
        if why:
            return why
    return ""
