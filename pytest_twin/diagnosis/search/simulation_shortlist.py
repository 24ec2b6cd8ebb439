"""What deserves a simulation: the best along the motion, and single terms where that says little.

Where deviations are far from small, single terms are simulated at all their starting sizes, limits
of drives as well, and gears wherever something stands out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.first_order.sensitivities import grid, starts_in_first_form
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.compensated_starts import compensated
from pytest_twin.diagnosis.search.distant_starts import distant
from pytest_twin.diagnosis.search.drive_limits import (
    FAR_OFF,
    limits_of_large_residuals,
    refine_limit_sizes,
    sizes_up_to_bound,
)
from pytest_twin.diagnosis.search.linearized_shortlist import LinearizedShortlist
from pytest_twin.diagnosis.search.linearized_view import LinearizedView
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search.settings import SHORTLIST
from pytest_twin.diagnosis.search.trial_simulation import TrialSimulation
from pytest_twin.diagnosis.verdict_settings import VERDICT


def simulation_shortlist(
    problem: Problem, best: ScoredModel, look: LinearizedView, found: LinearizedShortlist
) -> list[Hypothesis]:
    """Structures that are worth a simulation: where small deviations say little, others too."""
    starts, left = found.starts, found.left
    tryout = TrialSimulation(problem, best, left)
    if _bent(look, left, clear=bool(starts) and starts[0] in found.singles):
        scanned = _scanned(tryout, best, look, found)
        if not best.hypothesis.terms:
            scanned += distant(problem, best.hypothesis, look.view.mean_square)
    else:
        scanned = _yielding(tryout, best, look, found)
    alike = {h.terms for h in scanned}
    starts = [*(h for h in starts if h.terms not in alike), *scanned]
    if best.hypothesis.terms and starts:
        starts = _anchored(tryout, best, starts)
    if look.linear is None and starts:
        starts = _promising(tryout, best, starts)
    pairs = compensated(tryout, best.hypothesis)
    alike = {h.terms for h in pairs}
    starts = [*(h for h in starts if h.terms not in alike), *pairs]
    named = {t for h in starts for t in h.terms}
    return [*starts, *(h for h in _misread(problem, best) if h.terms[-1] not in named)]


def _misread(problem: Problem, best: ScoredModel) -> list[Hypothesis]:
    """Laws of the sensors of efforts that stand out: along the motion means over bins lie under the
    floor of single samples, which all of them may stand out of together.
    """
    joints = len(problem.joints)
    (out,) = np.nonzero((best.left > VERDICT.stands_out**2 * problem.signal_floor**2)[joints:])
    return [
        best.hypothesis.with_term(t, starts_in_first_form(t)[0])
        for t in candidates(problem)
        if t.law.overrides("sense_effort") and t.joint in out and t not in best.hypothesis.terms
    ]


def _anchored(
    tryout: TrialSimulation, best: ScoredModel, starts: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """Each start with the parameters of the linearized fit or of the simulated one, whichever
    leaves the smaller residual.
    """
    own = len(best.hypothesis.theta)
    kept = [h.with_theta(np.concatenate([best.hypothesis.theta, h.theta[own:]])) for h in starts]
    costs = tryout.costs([*starts, *kept])
    pairs = zip(starts, kept, costs[: len(starts)], costs[len(starts) :], strict=True)
    return [new if there > here else old for old, new, there, here in pairs]


def _promising(
    tryout: TrialSimulation, best: ScoredModel, starts: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """Of those that add least and of the others, the few that leave least as they are.

    In contact every fit is one by simulation: ranked along the motion are the others.
    """
    order = [starts[i] for i in np.argsort(tryout.costs(starts))]
    single = [h for h in order if h.more_terms(best.hypothesis) == 1]
    several = [h for h in order if h.more_terms(best.hypothesis) > 1]
    return single[: SHORTLIST.simulated_alone] + several[: SHORTLIST.simulated_alone]


def _bent(look: LinearizedView, left: FloatArray, *, clear: bool) -> bool:
    """Whether deviations are so far from small that slopes may lead nowhere.

    Args:
        left: (signals,) mean square that the best along the motion leaves.
        clear: whether that is a single term.
    """
    view = look.view
    if look.linear is None:
        return bool(view.above(left, FAR_OFF).any())
    far = view.above(view.mean_square, FAR_OFF).any()
    return bool(far and not (clear and not view.above(left, SHORTLIST.near).any()))


def _scanned(
    tryout: TrialSimulation, best: ScoredModel, look: LinearizedView, found: LinearizedShortlist
) -> list[Hypothesis]:
    """The best of what single terms do as they are and at all starting sizes, by simulation."""
    problem = tryout.problem
    terms = [h.terms[-1] for h in found.singles]
    seen = {*terms, *best.hypothesis.terms}
    terms += [t for t in _gears(problem, look, found.left, FAR_OFF) if t not in seen]
    rows = [best.hypothesis.with_term(t, start) for t in terms for start in starts_in_first_form(t)]
    whole = look.view.mean_square
    # Once, around the nominal model: they are many replays, and later residuals are smaller.
    limited = [] if best.hypothesis.terms else limits_of_large_residuals(problem, whole)
    limits = [t for t in limited if t not in look.failed]
    unseen = [t for t in limits if t not in seen]
    rows += [best.hypothesis.with_term(t, start) for t in unseen for start, _ in grid(t)[::2]]
    rows += found.singles
    needles = bool(look.view.above(whole, SHORTLIST.narrow).any())
    # A limit far below what is asked for is as likely as one that is hardly met.
    far = dict.fromkeys([*limits, *terms] if needles else limits)
    rows += [best.hypothesis.with_term(t, size) for t in far for size in sizes_up_to_bound(t)]
    ranked = tryout.cheapest(rows)
    few = ranked[: SHORTLIST.simulated_alone]
    honed = [h for h in ranked if h.terms[-1] in limits][: SHORTLIST.limits]
    if needles:
        honed += [h for h in few if h.terms[-1] not in limits]
    return tryout.cheapest([*few, *refine_limit_sizes(tryout, honed)])[: SHORTLIST.simulated_alone]


def _gears(problem: Problem, look: LinearizedView, left: FloatArray, floors: float) -> list[Term]:
    """Transmissions that may give where more than so many floors are left: they read the measured
    motion back, and say along it little of what they do.
    """
    joints = len(problem.joints)
    far = left[:joints] > (floors * problem.floor) ** 2
    return [
        t for t in candidates(problem)
        if t.law.is_elastic_transmission and far[t.joint] and t not in look.failed
    ]  # fmt: skip


def _yielding(
    tryout: TrialSimulation, best: ScoredModel, look: LinearizedView, found: LinearizedShortlist
) -> list[Hypothesis]:
    """The transmission that reduces the simulated residual most, if any."""
    own = best.hypothesis.terms
    seen = {*own, *(h.terms[-1] for h in found.starts if len(h.terms) == len(own) + 1)}
    gears = [
        t for t in _gears(tryout.problem, look, found.left, VERDICT.stands_out) if t not in seen
    ]
    rows = [best.hypothesis.with_term(t, start) for t in gears for start, _ in grid(t)]
    if not rows:
        return []
    bare, *costs = tryout.costs([best.hypothesis, *rows])
    least = int(np.argmin(np.nan_to_num(costs, nan=np.inf)))
    return [rows[least]] if costs[least] < bare else []
