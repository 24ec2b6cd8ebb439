"""Shortlist of sets of effects that are fitted by simulation.

It holds the best sets of the linearized motion. If the error is too large for a linearization,
single effects are also simulated at all their starting sizes, with limits of drives. Elastic
transmissions are simulated at every joint with a residual above the noise floor.
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
    problem: Problem, best: ScoredModel, linearized: LinearizedView, found: LinearizedShortlist
) -> list[Hypothesis]:
    """Hypotheses to be fitted by simulation.

    Args:
        problem: the problem.
        best: the present fit.
        linearized: the linearization around it.
        found: the best sets in the linearized motion.
    """
    starts, left = found.starts, found.left
    trial_simulation = TrialSimulation(problem, best, left)
    if _is_strongly_nonlinear(linearized, left, clear=bool(starts) and starts[0] in found.singles):
        scanned = _scanned(trial_simulation, best, linearized, found)
        if not best.hypothesis.terms:
            scanned += distant(problem, best.hypothesis, linearized.view.mean_square)
    else:
        scanned = _best_transmission(trial_simulation, best, linearized, found)
    alike = {h.terms for h in scanned}
    starts = [*(h for h in starts if h.terms not in alike), *scanned]
    if best.hypothesis.terms and starts:
        starts = _with_better_parameters(trial_simulation, best, starts)
    if linearized.linear is None and starts:
        starts = _promising(trial_simulation, best, starts)
    pairs = compensated(trial_simulation, best.hypothesis)
    alike = {h.terms for h in pairs}
    starts = [*(h for h in starts if h.terms not in alike), *pairs]
    named = {t for h in starts for t in h.terms}
    return [*starts, *(h for h in effort_sensor_terms(problem, best) if h.terms[-1] not in named)]


def effort_sensor_terms(problem: Problem, best: ScoredModel) -> list[Hypothesis]:
    """The fit with one effort sensor effect in addition, at joints with a large effort residual.

    The linearized search compares means over bins with the noise floor of single samples, so it may
    miss an offset of the effort that is below the floor in each bin.
    """
    joints = len(problem.joints)
    (out,) = np.nonzero((best.left > VERDICT.stands_out**2 * problem.signal_floor**2)[joints:])
    return [
        best.hypothesis.with_term(t, starts_in_first_form(t)[0])
        for t in candidates(problem)
        if t.law.overrides("sense_effort") and t.joint in out and t not in best.hypothesis.terms
    ]


def _with_better_parameters(
    trial_simulation: TrialSimulation, best: ScoredModel, starts: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """Each start with the better parameters of the present terms.

    These are either those of the present fit or those of the linearized fit.
    """
    own = len(best.hypothesis.theta)
    kept = [h.with_theta(np.concatenate([best.hypothesis.theta, h.theta[own:]])) for h in starts]
    costs = trial_simulation.costs([*starts, *kept])
    pairs = zip(starts, kept, costs[: len(starts)], costs[len(starts) :], strict=True)
    return [new if there > here else old for old, new, there, here in pairs]


def _promising(
    trial_simulation: TrialSimulation, best: ScoredModel, starts: Sequence[Hypothesis]
) -> list[Hypothesis]:
    """The starts with the smallest error without a fit: some with one new effect, some with more.

    It is used in contact, where no linearization ranks the starts.
    """
    order = [starts[i] for i in np.argsort(trial_simulation.costs(starts))]
    single = [h for h in order if h.more_terms(best.hypothesis) == 1]
    several = [h for h in order if h.more_terms(best.hypothesis) > 1]
    return single[: SHORTLIST.simulated_alone] + several[: SHORTLIST.simulated_alone]


def _is_strongly_nonlinear(linearized: LinearizedView, left: FloatArray, *, clear: bool) -> bool:
    """Whether the error is so large that the linearization may be invalid.

    Args:
        linearized: the linearization around the present fit.
        left: (signals,) mean squared residual of the best set in the linearized motion.
        clear: whether this set adds a single effect.
    """
    view = linearized.view
    if linearized.linear is None:
        return bool(view.above(left, FAR_OFF).any())
    far = view.above(view.mean_square, FAR_OFF).any()
    return bool(far and not (clear and not view.above(left, SHORTLIST.near).any()))


def _scanned(
    trial_simulation: TrialSimulation,
    best: ScoredModel,
    linearized: LinearizedView,
    found: LinearizedShortlist,
) -> list[Hypothesis]:
    """The best single effects by simulation, at fitted sizes and at all starting sizes."""
    problem = trial_simulation.problem
    terms = [h.terms[-1] for h in found.singles]
    seen = {*terms, *best.hypothesis.terms}
    terms += [
        t for t in _elastic_transmissions(problem, linearized, found.left, FAR_OFF) if t not in seen
    ]
    rows = [best.hypothesis.with_term(t, start) for t in terms for start in starts_in_first_form(t)]
    whole = linearized.view.mean_square
    # Only at the nominal model: this takes many simulations, and later residuals are smaller.
    limited = [] if best.hypothesis.terms else limits_of_large_residuals(problem, whole)
    limits = [t for t in limited if t not in linearized.failed]
    unseen = [t for t in limits if t not in seen]
    rows += [best.hypothesis.with_term(t, start) for t in unseen for start, _ in grid(t)[::2]]
    rows += found.singles
    has_narrow_minima = bool(linearized.view.above(whole, SHORTLIST.narrow).any())
    # A limit far below the demand is as likely as one that is rarely reached.
    far = dict.fromkeys([*limits, *terms] if has_narrow_minima else limits)
    rows += [best.hypothesis.with_term(t, size) for t in far for size in sizes_up_to_bound(t)]
    ranked = trial_simulation.cheapest(rows)
    few = ranked[: SHORTLIST.simulated_alone]
    refined = [h for h in ranked if h.terms[-1] in limits][: SHORTLIST.limits]
    if has_narrow_minima:
        refined += [h for h in few if h.terms[-1] not in limits]
    return trial_simulation.cheapest([*few, *refine_limit_sizes(trial_simulation, refined)])[
        : SHORTLIST.simulated_alone
    ]


def _elastic_transmissions(
    problem: Problem, linearized: LinearizedView, left: FloatArray, floors: float
) -> list[Term]:
    """Elastic transmissions at joints with an RMS residual above ``floors`` noise floors.

    The linearization along the measured link motion hardly shows their influence.
    """
    joints = len(problem.joints)
    far = left[:joints] > (floors * problem.floor) ** 2
    return [
        t for t in candidates(problem)
        if t.law.is_elastic_transmission and far[t.joint] and t not in linearized.failed
    ]  # fmt: skip


def _best_transmission(
    trial_simulation: TrialSimulation,
    best: ScoredModel,
    linearized: LinearizedView,
    found: LinearizedShortlist,
) -> list[Hypothesis]:
    """The elastic transmission that reduces the simulated error most, as a list; empty if none."""
    own = best.hypothesis.terms
    seen = {*own, *(h.terms[-1] for h in found.starts if len(h.terms) == len(own) + 1)}
    gears = [
        t
        for t in _elastic_transmissions(
            trial_simulation.problem, linearized, found.left, VERDICT.stands_out
        )
        if t not in seen
    ]
    rows = [best.hypothesis.with_term(t, start) for t in gears for start, _ in grid(t)]
    if not rows:
        return []
    bare, *costs = trial_simulation.costs([best.hypothesis, *rows])
    least = int(np.argmin(np.nan_to_num(costs, nan=np.inf)))
    return [rows[least]] if costs[least] < bare else []
