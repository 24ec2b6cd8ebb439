"""Parameters with which a joint generates no energy, while its drive is on and while it is off.

Models hold back-EMF as passive damping, together with the viscous friction of motor and gear. A
drive that is switched off or saturated has none, so it must not exceed the whole damping.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis import physical_totals
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import Parameter
from pytest_twin.estimation.hypothesis import Hypothesis, Term

# A back-EMF may exceed the damping by this share of it: rounding of a fit that ends at the bound.
_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True)
class _BackEmf:
    """The back-EMF of a term and the damping that contains it, N*m*s/rad or N*s/m.

    Attributes:
        term: the effect that takes the back-EMF out of the damping.
        at: index in theta.
        whole: damping of the model and all corrections of it; at least zero.
    """

    term: Term
    at: int
    value: float
    whole: float
    scale: float

    @property
    def exceeds(self) -> bool:
        """Whether the back-EMF exceeds the damping."""
        return self.value > (1.0 + _TOLERANCE) * self.whole


def impossible(problem: Problem, hypothesis: Hypothesis) -> dict[Term, str]:
    """Terms with which a joint would generate energy, and the reason of each."""
    found = {
        one.term: f"its back-EMF of {one.value:.3g} would exceed the total damping of the joint, "
        f"{one.whole:.3g}"
        for one in _back_emfs(problem, hypothesis)
        if one.exceeds
    }
    return {**found, **physical_totals.impossible_effects(problem, hypothesis)}


def has_excessive_back_emf(problem: Problem, hypothesis: Hypothesis) -> bool:
    """Whether a back-EMF exceeds the damping of its joint."""
    return any(one.exceeds for one in _back_emfs(problem, hypothesis))


def with_largest_back_emf(problem: Problem, hypothesis: Hypothesis) -> Hypothesis:
    """The hypothesis with each back-EMF equal to the damping that contains it."""
    theta = hypothesis.theta.copy()
    for one in _back_emfs(problem, hypothesis):
        theta[one.at] = min(one.whole / one.scale, hypothesis.bounds[1][one.at])
    return hypothesis.with_theta(theta)


@dataclass(frozen=True, slots=True)
class LargestBackEmf:
    """A problem in which the back-EMF of each drive is the whole damping of its joint.

    Where the damping is fitted too, the back-EMF follows it.
    """

    problem: Problem

    def residuals(
        self, hypotheses: Sequence[Hypothesis], segments: NDArray[np.int64]
    ) -> list[FloatArray]:
        """(samples, signals) residual of each hypothesis with these back-EMFs."""
        bounded = [with_largest_back_emf(self.problem, one) for one in hypotheses]
        return self.problem.residuals(bounded, segments)


def _back_emfs(problem: Problem, hypothesis: Hypothesis) -> Iterator[_BackEmf]:
    """The parameters of a hypothesis that are a part of their joint's damping."""
    for term in hypothesis.terms:
        start = hypothesis.slice_of(term).start
        for k, parameter in enumerate(term.parameters):
            if parameter.part_of == "damping" and term.joint >= 0:
                scale = problem.scales.value(parameter, term.joint)
                value = float(hypothesis.theta[start + k]) * scale
                whole = max(_damping(problem, hypothesis, term.joint), 0.0)
                yield _BackEmf(term, start + k, value, whole, scale)


def _damping(problem: Problem, hypothesis: Hypothesis, joint: int) -> float:
    """Damping of a joint: of the model, of fixed effects, and of the hypothesis."""
    simulator = problem.simulator
    whole = float(simulator.segments[0].model.dof_damping[simulator.layout.dof_index[joint]])
    for effect, values in simulator.fixed.items():
        for parameter in catalogue()[effect].parameters:
            if _adds_damping(parameter):
                whole += float(values[parameter.name][0, joint])
    for term in hypothesis.terms:
        values_of_term = hypothesis.theta[hypothesis.slice_of(term)]
        for parameter, value in zip(term.parameters, values_of_term, strict=True):
            if term.joint == joint and _adds_damping(parameter):
                whole += float(value) * problem.scales.value(parameter, joint)
    return whole


def _adds_damping(parameter: Parameter) -> bool:
    return parameter.relation == "added" and parameter.quantity == "damping"
