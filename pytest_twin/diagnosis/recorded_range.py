"""Where the recordings can show a parameter that shapes an effect.

A warm-up of minutes in recordings of seconds, a Stribeck velocity above the greatest speed, a
ripple finer than the samples: there the shape of the effect is not in the data. A fit that ends
there compensates for another effect, so no finding may lie there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.base import Parameter

# Time constants up to this many times the longest recording: within it, a transient of three times
# its length has passed by 28 %; of a longer one only the initial slope is seen.
_LONGEST = 3.0
# Share of the greatest speed above which a joint moves, and quantile of its steps between samples
# that counts as finely sampled.
_MOVES, _FINE = 0.05, 0.25
# Samples that a range of speeds must contain to be seen.
_FEWEST = 5


@dataclass(frozen=True, slots=True)
class RecordedRange:
    """What the recordings cover.

    Attributes:
        duration: s, longest time that a recording covers.
        speeds: per joint, (samples,) absolute speeds, sorted, rad/s or m/s.
        step: (joints,) rad or m, between two samples while a joint moves, where it moves slowly.
        travel: (joints,) rad or m, between its ends.
        noise: (joints,) rad or m.
        differ_in_temperature: whether some recordings were colder than others.
    """

    duration: float
    speeds: tuple[FloatArray, ...]
    step: FloatArray
    travel: FloatArray
    noise: FloatArray
    differ_in_temperature: bool

    @classmethod
    def of(cls, problem: Problem) -> RecordedRange:
        """Measured from the positions of all segments."""
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
            moving = speed[:, j] > _MOVES * speed[:, j].max()
            fine[j] = np.quantile(step[moving, j], _FINE) if moving.any() else 0.0
        return cls(
            max(last.values()),
            tuple(np.sort(speed[:, j]) for j in range(joints)),
            fine,
            np.ptp(position, axis=0),
            problem.floor,
            problem.differ_in_temperature,
        )

    def hides(self, term: Term, parameter: Parameter, value: float) -> str:
        """Why the recordings cannot show a shape parameter at this SI value; empty if they can."""
        if parameter.neutral is not None or parameter.reference == "twelfth":
            return ""
        j = max(term.joint, 0)
        name = parameter.name.replace("_", " ")
        if parameter.quantity == "time":
            lasting = term.law.needs_temperature and self.differ_in_temperature
            if value > _LONGEST * self.duration and not lasting:
                return f"a {name} of {value:.3g} s, in recordings of at most {self.duration:.3g} s"
        elif parameter.quantity == "velocity":
            fastest = float(self.speeds[j][-1])
            if value > fastest:
                return f"a {name} of {value:.3g}, above the greatest speed ({fastest:.3g})"
            below = np.searchsorted(self.speeds[j], value)
            if len(self.speeds[j]) - below < _FEWEST:
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


def not_shown(
    problem: Problem, hypothesis: Hypothesis, recorded: RecordedRange | None = None
) -> dict[Term, str]:
    """Effects with a shape that the recordings cannot show, and why.

    Args:
        problem: what to explain.
        hypothesis: effects with parameters.
        recorded: what the recordings cover, where it is known.
    """
    recorded = RecordedRange.of(problem) if recorded is None else recorded
    out: dict[Term, str] = {}
    for term in hypothesis.terms:
        theta = hypothesis.theta[hypothesis.slice_of(term)]
        why = hidden_at(problem, recorded, term, theta)
        if why:
            out[term] = why
    return out


def hidden_at(problem: Problem, recorded: RecordedRange, term: Term, theta: FloatArray) -> str:
    """Why the recordings cannot show an effect with these scaled parameters; empty if they can."""
    has = term.law.has(theta)
    for k, p in enumerate(term.parameters):
        if not has[k]:
            continue
        why = recorded.hides(term, p, float(theta[k]) * problem.scales.value(p, term.joint))
        if why:
            return why
    return ""
