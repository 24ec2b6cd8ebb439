"""Limits of drives: along a motion that is far off they are needles, and simulated they are not.

Where a drive is at its limit it does not feel how far behind it is, and to first order neither does
any law that would take it off that limit: a setpoint that moves slowly, whose servo follows it
closely, seems far worse than a drive that is too weak to follow a fast one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.first_order.sensitivities import grid, starts_in_first_form
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search.trial_simulation import TrialSimulation
from pytest_twin.diagnosis.verdict_settings import VERDICT

FAR_OFF = 10.0
"""Floors beyond which slopes may lead nowhere."""
# Laws are honed by so many sizes within these factors, one after the other.
_NEIGHBOURS, _HONED = 9, (1.25, 1.05)
# Joints whose drives are scanned for limits.
_LIMITED = 2


def limits_of_large_residuals(problem: Problem, whole: FloatArray) -> list[Term]:
    """Limits of the drives where most is to be explained: along the motion they are needles, and
    simulated they are not.
    """
    joints = len(problem.joints)
    floors = np.sqrt(whole[:joints]) / problem.floor
    most = [j for j in np.argsort(-floors)[:_LIMITED] if floors[j] > FAR_OFF]
    return [
        t for t in candidates(problem)
        if t.joint in most and t.law.is_limit and t.lone(starts_in_first_form(t)[0]) is not None
    ]  # fmt: skip


def doubtful_limits(problem: Problem, best: ScoredModel) -> list[Term]:
    """Limits of drives at joints that still stand out."""
    out = (best.left > VERDICT.stands_out**2 * problem.signal_floor**2).reshape(
        -1, len(problem.joints)
    )
    return [t for t in best.hypothesis.terms if _limits(t) and out[:, t.joint].any()]


def limits_instead(problem: Problem, best: ScoredModel, places: Sequence[Term]) -> list[Hypothesis]:
    """In the place of each of these limits, the other one of the same drive that leaves least as it
    is.

    Args:
        problem: what to explain.
        best: the fit at hand.
        places: limits that it has.
    """
    own, tryout = best.hypothesis, TrialSimulation(problem, best, best.left)
    found = []
    for gone in places:
        others = [
            t for t in candidates(problem)
            if t.joint == gone.joint and _limits(t) and t not in own.terms
        ]  # fmt: skip
        rows = [
            own.without(gone).with_term(t, size)
            for t in others
            for size in [*(start for start, _ in grid(t)), *sizes_up_to_bound(t)]
        ]
        honed = refine_limit_sizes(tryout, tryout.cheapest(rows)) if rows else []
        found += honed[:1]
    return found


def _limits(term: Term) -> bool:
    """Whether a term limits what the drive of one joint does."""
    return term.joint >= 0 and term.law.is_limit


def refine_limit_sizes(
    tryout: TrialSimulation, hypotheses: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """Hypotheses at the best of the sizes about those of their last terms, best first."""
    honed = list(hypotheses)
    for reach in _HONED:
        honed = tryout.cheapest([h for f in honed for h in _about(f, reach)])
    return honed


def sizes_up_to_bound(term: Term) -> list[FloatArray]:
    """Sizes of a limit from its last starting size to its bound, for each form with one parameter;
    empty for other laws.
    """
    out = []
    for start, _ in grid(term) if term.law.is_limit else ():
        lone = term.lone(start)
        if lone is None:
            continue
        p = term.parameters[lone]
        if start[lone] != p.starts[-1] or len(p.starts) < 2:
            continue
        ratio = p.starts[-1] / p.starts[-2]
        for k in range(int(np.log(p.upper / p.starts[-1]) / np.log(ratio))):
            size = start.copy()
            size[lone] *= ratio ** (k + 1)
            out.append(size)
    return out


def _about(hypothesis: Hypothesis, reach: float) -> list[Hypothesis]:
    """A hypothesis, and where a fit moves one parameter of its last term, its neighbours within a
    factor.
    """
    term = hypothesis.terms[-1]
    mine = hypothesis.slice_of(term)
    lone = term.lone(hypothesis.theta[mine])
    if lone is None:
        return [hypothesis]
    p = term.parameters[lone]
    at = mine.start + lone
    out = []
    for factor in np.geomspace(1.0 / reach, reach, _NEIGHBOURS):
        theta = hypothesis.theta.copy()
        theta[at] = np.clip(theta[at] * factor, p.lower, p.upper)
        out.append(hypothesis.with_theta(theta))
    return out
