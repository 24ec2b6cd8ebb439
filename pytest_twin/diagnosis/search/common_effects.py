"""One cause that acts at every joint alike: the same effect at all joints with the same values.

The catalogue has it as one effect for each joint. A bus that is late delays the commands of all
joints by the same time. That is one cause with one parameter, like a delay of all readings.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.simplification import mean_start, values_of
from pytest_twin.diagnosis.servo_priors import MOST_SURPRISE, surprise
from pytest_twin.estimation.comparison import Size
from pytest_twin.estimation.hypothesis import Hypothesis, Term

_ALIKE = 0.01
"""Relative difference of the values of all joints below which they are one cause: independent fits
of one value to noisy recordings differ by as much."""


def idle_parameters(problem: Problem, terms: Iterable[Term]) -> dict[Term, NDArray[np.bool_]]:
    """Term -> (parameters,) whether each changes nothing in this robot's drives; if one does."""
    drives = problem.simulator.models.world(problem.fit[:1])
    found = {
        term: ~term.law.acts_on_servo(
            float(drives.stiffness[0, term.joint]), float(drives.damping[0, term.joint])
        )
        for term in terms
        if term.joint >= 0
    }
    return {term: idle for term, idle in found.items() if idle.any()}


def set_size(
    problem: Problem, hypothesis: Hypothesis, idle: Mapping[Term, NDArray[np.bool_]]
) -> Size:
    """Number of effects and parameters of a set, where common effects count once.

    With what the priors of the servos and the usual sizes say of its parameters.

    Args:
        idle: parameters of a term that change nothing.
    """
    repeated = [t for group in _common_groups(problem, hypothesis) for t in group[1:]]
    values = hypothesis.theta
    repeated_parameters = sum(
        int(t.is_estimated(values[hypothesis.slice_of(t)]).sum()) for t in repeated
    )
    without_influence = sum(int(idle[t].sum()) for t in hypothesis.terms if t in idle)
    return Size(
        len(hypothesis.terms) - len(repeated),
        hypothesis.free_count - repeated_parameters - without_influence,
        surprise(problem, hypothesis) + _unusual_sizes(hypothesis),
    )


def _unusual_sizes(hypothesis: Hypothesis) -> float:
    """Minus the log-density of values of which the usual size is known, relative to the neutral.

    It is at most ``MOST_SURPRISE`` for each: a part may be another one than the model says.
    """
    out = 0.0
    for term in hypothesis.terms:
        values = hypothesis.theta[hypothesis.slice_of(term)]
        for parameter, value in zip(term.parameters, values.tolist(), strict=True):
            if parameter.usual is not None:
                deviation = (value - parameter.absent_value) / parameter.usual
                out += min(0.5 * deviation**2, MOST_SURPRISE)
    return out


def replace_robot_effects(problem: Problem, hypothesis: Hypothesis) -> list[Hypothesis]:
    """Sets with an effect at every joint instead of an effect of the whole robot.

    For example the same command delay at all joints instead of a sensor delay. These are effects
    that the catalogue lists as confused with the one of the robot, if all parameters of both have
    the same name and quantity. They start with its values.
    """
    joints = range(len(problem.joints))
    possible = set(candidates(problem))
    out = []
    for term in hypothesis.terms:
        for effect in term.law.confused_with if term.joint < 0 and len(joints) > 1 else ():
            each = [Term(effect, j) for j in joints]
            is_new = possible.issuperset(each) and not set(each) & set(hypothesis.terms)
            if is_new and _quantities(term) == _quantities(each[0]):
                starts = {t: mean_start(problem, hypothesis, [term], t) for t in each}
                out.append(hypothesis.without(term).with_terms(starts))
    return out


def _common_groups(problem: Problem, hypothesis: Hypothesis) -> list[list[Term]]:
    """Groups of terms: one effect with nearly the same values at every joint of several."""
    count, out = len(problem.joints), list[list[Term]]()
    for effect in dict.fromkeys(t.effect for t in hypothesis.terms if t.joint >= 0):
        each = [t for t in hypothesis.terms if t.effect == effect]
        if count > 1 and len(each) == count:
            values = [list(values_of(problem, hypothesis, t).values()) for t in each]
            if np.allclose(values, values[0], rtol=_ALIKE, atol=0.0):
                out.append(each)
    return out


def _quantities(term: Term) -> set[tuple[str, str]]:
    """Name and quantity of each parameter of a term."""
    return {(p.name, p.quantity) for p in term.parameters}
