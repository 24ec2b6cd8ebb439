"""Limits of drives (rate, torque, torque at speed), which are compared by simulation.

While a drive is at its limit, its effort does not depend on the tracking error. A linearization
around such a motion is therefore wrong for every law that takes the drive off its limit: it would
prefer a weak drive to a slow setpoint that the servo follows closely.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.search.cost_screen import CostScreen
from pytest_twin.diagnosis.search.proposed_starts import starts_at
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.estimation.hypothesis import Hypothesis, Term

# A size is refined in two rounds, each over a geometric grid of ``_SIZES`` within these factors.
_SIZES, _REFINEMENTS = 9, (1.25, 1.05)


def doubtful_limits(best: ScoredModel) -> list[Term]:
    """Limits in the fit at joints whose residual is above the noise floor."""
    problem = best.problem
    out = (best.max_mean_square > VERDICT.identifiable**2 * problem.signal_floor**2).reshape(
        -1, len(problem.joints)
    )
    return [t for t in best.hypothesis.terms if _is_limit(t) and out[:, t.joint].any()]


def replace_limits(best: ScoredModel, places: Sequence[Term]) -> list[Hypothesis]:
    """For each limit in ``places``: the fit with the best other limit of the same drive instead.

    The other limit has the size with the smallest error; the remaining parameters are not fitted.

    Args:
        places: limits in the present fit.
    """
    own, cost_screen = best.hypothesis, CostScreen(best, best.max_mean_square)
    found = []
    for removed in places:
        others = [
            t for t in candidates(best.problem)
            if t.joint == removed.joint and _is_limit(t) and t not in own.terms
        ]  # fmt: skip
        rows = [
            own.without(removed).with_term(t, start.parameters)
            for t in others
            for start in starts_at(best.problem, own, t)
        ]
        refined = (
            refine_limit_sizes(cost_screen, cost_screen.best_of_each_term(rows)) if rows else []
        )
        found += refined[:1]
    return found


def _is_limit(term: Term) -> bool:
    """Whether a term is a limit of the drive of one joint."""
    return term.joint >= 0 and term.law.is_limit


def refine_limit_sizes(
    cost_screen: CostScreen, hypotheses: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """Hypotheses with the size of their last term refined on a grid, best first."""
    refined = list(hypotheses)
    for max_factor in _REFINEMENTS:
        refined = cost_screen.best_of_each_term(
            [h for f in refined for h in _vary_size(f, max_factor)]
        )
    return refined


def _vary_size(hypothesis: Hypothesis, max_factor: float) -> list[Hypothesis]:
    """The hypothesis with the size of its last term times factors up to ``max_factor``.

    The hypothesis alone if its last term has several estimated parameters.
    """
    term = hypothesis.terms[-1]
    mine = hypothesis.slice_of(term)
    index = term.only_estimated_parameter(hypothesis.theta[mine])
    if index is None:
        return [hypothesis]
    p = term.parameters[index]
    at = mine.start + index
    out = []
    for factor in np.geomspace(1.0 / max_factor, max_factor, _SIZES):
        theta = hypothesis.theta.copy()
        theta[at] = np.clip(theta[at] * factor, p.lower, p.upper)
        out.append(hypothesis.with_theta(theta))
    return out
