"""Other sets of effects that predict the recordings as well as the set that was found.

Some sets are not distinguishable on some recordings, for example command and sensor delay of one
joint, or base tilt and encoder bias about parallel axes. Confidences have to include such sets.
Subsets of the final set are removed. A beam search over all candidates in the linearized motion
proposes other sets with the same prediction. The closest ones are fitted in the linearized motion,
then by simulation with the Jacobian of the linearized motion, which needs no simulations.
"""

from __future__ import annotations

import contextlib
import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.common_effects import (
    replace_robot_effects,
    set_size,
    tie_common_parameters,
)
from pytest_twin.diagnosis.effort_step_tolerance import residuals_with_step_tolerance
from pytest_twin.diagnosis.equivalent_settings import EQUIVALENT
from pytest_twin.diagnosis.first_order.beam_search import (
    CandidateSensitivities,
    NormalEquations,
    ResidualView,
    Structure,
)
from pytest_twin.diagnosis.first_order.linearized_fit import (
    NEAR_ITERATIONS,
    LinearizedFit,
    fit_linearized,
    linearized_slopes,
)
from pytest_twin.diagnosis.first_order.sensitivities import Linearization
from pytest_twin.diagnosis.patched.native import mjcf_expresses
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.linearized_view import linearize_around
from pytest_twin.diagnosis.search.model_comparison import RANKING_ITERATIONS, ModelComparison
from pytest_twin.diagnosis.search.noise_levels import in_noise_floors
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search.settings import SELECTION
from pytest_twin.diagnosis.search.term_exchange import residuals_without
from pytest_twin.diagnosis.set_evidence import (
    evidence_on,
    idle_parameters,
    log_misfit,
    recordings_of,
    set_evidence,
    set_penalty,
)
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel, propose_step, weighted_cost
from pytest_twin.estimation.score import NOISE_FLOORS, log_likelihood, tempered_samples

# Levenberg-Marquardt dampings, as shares of the diagonal of the normal matrix.
_DAMPINGS = (1e-4, 1e-1)

Allowed = Callable[[Hypothesis], bool]
"""Whether a set is physically possible and within the range that the recordings cover."""


@dataclass(frozen=True, slots=True)
class AlternativeSet:
    """Another set of effects, fitted by simulation.

    Attributes:
        evidence: penalized log-likelihood relative to the final set, tempered for model error.
        prediction_difference: largest RMS difference between its prediction and that of the
            final set on the fit recordings, in noise floors.
    """

    model: ScoredModel
    evidence: float
    prediction_difference: float

    @property
    def terms(self) -> frozenset[Term]:
        """The terms of the set."""
        return frozenset(self.model.hypothesis.terms)


@dataclass(frozen=True, slots=True)
class ComparedSets:
    """The most likely set and its alternatives.

    Attributes:
        best: the final set, or a more likely one.
        sets: all other sets with their evidence relative to ``best``, most likely first.
        tempering: ratio of the effective sample sizes with and without model error.
        simulations: number of simulations of all recordings that the comparison took.
        gain: evidence of ``best`` relative to the final set; minus infinity if no set is possible.
        is_complete: whether all sets were fitted. Otherwise the time ended before: ``best`` is the
            final set, and the evidence of the others is a lower bound.
    """

    best: ScoredModel
    sets: tuple[AlternativeSet, ...]
    tempering: float
    simulations: float
    gain: float = 0.0
    is_complete: bool = True


def compare_sets(
    comparison: ModelComparison,
    found: Hypothesis,
    allowed: Allowed = lambda h: True,
    known: Sequence[Hypothesis] = (),
) -> ComparedSets:
    """Compare a fitted set of effects with others that predict the same.

    Args:
        comparison: the comparison of the problem.
        found: the final set with its fitted parameters.
        allowed: whether a set may be reported. If the final set may not, the most likely other set
            replaces it.
        known: other sets that explain nearly as much, fitted, best first.

    Returns:
        The comparison; without alternatives if the robot touches a surface, because there is no
        linearization in contact.

    Raises:
        OutOfTime: the time is over before any other set was simulated, or the final set may not be
            reported and the time is over before the others were fitted.
    """
    problem = comparison.problem
    count = _SimulationCount(problem)
    best = comparison.score_without_fit(found, slopes=True)
    linearized = linearize_around(best)
    if linearized.linear is None or not found.terms or not np.isfinite(best.fitted.cost):
        return ComparedSets(best, (), 1.0, count.spent)
    proposed = _propose_sets(
        comparison,
        best,
        linearized.linear,
        linearized.view,
        linearized.candidate_sensitivities,
        allowed,
        known,
    )
    models, is_complete = _fit_by_simulation(comparison, best, linearized.linear, proposed, count)
    models = [r for r in models if allowed(r.hypothesis) and np.isfinite(r.fitted.cost)]
    if is_complete:
        with contextlib.suppress(OutOfTime):
            return _rank_sets(comparison, best, models, linearized.linear, count, allowed(found))
    if not allowed(found):
        raise OutOfTime
    with comparison.run.budget.reserved():
        return _rank_unfinished_sets(comparison, best, models, linearized.linear, count)


class _SimulationCount:
    """Counts simulations of all recordings since its creation, without those from the cache.

    Attributes:
        fitted: steps of one simulation of the fit recordings, as a share of all recordings.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._steps_per_simulation = max(int(problem.simulator.steps.sum()), 1)
        self._steps_before = self._new_steps()
        self.fitted = float(problem.simulator.steps[problem.fit].sum()) / self._steps_per_simulation

    def _new_steps(self) -> int:
        return self._problem.simulated_steps - self._problem.cached_steps

    @property
    def spent(self) -> float:
        """Number of simulations of all recordings so far."""
        return (self._new_steps() - self._steps_before) / self._steps_per_simulation


def removed_subsets(terms: Sequence[Term]) -> list[tuple[Term, ...]]:
    """Subsets of the final set that are removed.

    These are single terms, all terms, all terms of a joint, the same effect at several joints, then
    pairs and triples of a joint and of the robot.
    """
    out: dict[tuple[Term, ...], None] = dict.fromkeys((t,) for t in terms)
    if len(terms) <= EQUIVALENT.largest + 1:
        out[tuple(terms)] = None
    joints = {t.joint for t in terms if t.joint >= 0}
    by_joint = [tuple(t for t in terms if t.joint in (j, -1)) for j in sorted(joints)]
    alike = [
        tuple(t for t in terms if t.effect == effect)
        for effect in sorted({t.effect for t in terms})
    ]
    out.update(dict.fromkeys(c for c in (*by_joint, *alike) if c))
    for size in range(2, EQUIVALENT.largest + 1):
        for group in by_joint:
            out.update(dict.fromkeys(itertools.combinations(group, size)))
    return list(out)[: EQUIVALENT.most_subsets]


def _propose_sets(
    comparison: ModelComparison,
    best: ScoredModel,
    linear: Linearization,
    view: ResidualView,
    candidate_sensitivities: CandidateSensitivities,
    allowed: Allowed,
    known: Sequence[Hypothesis],
) -> list[Hypothesis]:
    """Other sets with nearly the same prediction, fitted in the linearized motion.

    The most likely ones come first. The final set without some of its terms may be among them.
    """
    own, found = best.hypothesis, list[tuple[float, Hypothesis]]()
    alike, similar = (
        replace_robot_effects(comparison.problem, own),
        list[tuple[float, Hypothesis]](),
    )
    places = removed_subsets(own.terms)
    residuals = residuals_without(best.problem, linear, view, own, places)
    elastic = candidate_sensitivities.elastic_transmissions
    for removed, left in zip(places, residuals, strict=True):
        rest = own.without(*removed)
        slope = view.jacobian[:, :, own.parameters_without(*removed)]
        # An elastic transmission is only replaced by another one. The search has decided by
        # simulation whether there is one.
        exchanged = any(t.law.is_elastic_transmission for t in removed)
        excluded = own.terms if exchanged else (*own.terms, *elastic)
        equations = NormalEquations(
            ResidualView(left, slope, view.floor, view.lengths), candidate_sensitivities
        )
        sets = _beam(equations, excluded, EQUIVALENT.largest if len(removed) == 1 else len(removed))
        fits = [LinearizedFit(rest.with_terms(s.starts), s.residual) for s in sets]
        evidence = _linearized_evidence(comparison, view, own, fits)
        for i in _select_for_fit(removed, sets, evidence, [allowed(f.hypothesis) for f in fits]):
            h = fits[i].hypothesis
            found.append((float(evidence[i]), h))
            same = _with_carried_values(comparison.problem, own, removed, h)
            found += [(float(evidence[i]), c) for c in same]
            alike += [c for c in same if len(c.terms) <= len(own.terms)]
        found.append((np.inf if len(removed) == 1 else -np.inf, rest))
        change = ResidualView(left - view.residual, slope, view.floor, view.lengths)
        similar += [
            (similarity - h.free_count, h)
            for similarity, chosen in _most_similar(
                NormalEquations(change, candidate_sensitivities), excluded
            )
            if similarity > EQUIVALENT.similar
            and allowed(h := rest.with_terms(equations.structure(chosen).starts))
        ]
    # Of sets that predict most of the change, those with the fewest parameters come first.
    closest = _limit_starts(similar, 1)[: EQUIVALENT.closest]
    more = without_mere_additions(found, own.terms, EQUIVALENT.starts)
    starts = [*closest, *more[: EQUIVALENT.fitted_along_motion - len(closest)]]
    fitted = fit_linearized(linear, view, starts, NEAR_ITERATIONS)
    values = _linearized_evidence(comparison, view, own, fitted).tolist()
    ranked = [
        (e, f.hypothesis) for e, f in zip(values, fitted, strict=True) if allowed(f.hypothesis)
    ]
    # The linearization is exact for small effects only. Structurally equivalent sets may seem to
    # differ, so they are simulated with the parameters of the effects that they replace.
    likeliest = without_mere_additions(ranked, own.terms, 1)
    fewer = [h for h in likeliest if len(h.terms) < len(own.terms)]
    others = [h for h in known if not set(own.terms) <= set(h.terms) and allowed(h)]
    out = [
        *(h for h in alike[: EQUIVALENT.with_same_parameters] if allowed(h)),
        *others[: EQUIVALENT.of_search],
        *fewer[: EQUIVALENT.with_fewer_effects],
        *(f.hypothesis for f in fitted[: len(closest)] if allowed(f.hypothesis)),
        *likeliest,
    ]
    return list({(h.terms, h.theta.tobytes()): h for h in out}.values())[: EQUIVALENT.simulated]


def _beam(equations: NormalEquations, excluded: Sequence[Term], largest: int) -> list[Structure]:
    """The best sets of up to ``largest`` candidates in place of the removed terms."""
    level, out = [equations.base], list[Structure]()
    for _ in range(largest):
        chosen = {
            frozenset(c): c
            for s in level
            for c in equations.children(
                s, EQUIVALENT.children if s.chosen else EQUIVALENT.single, [*excluded, *s.starts]
            )
        }
        if not chosen:
            break
        ranked = equations.rank(level[0], [equations.structure(c) for c in chosen.values()])
        out += ranked
        level = ranked[: EQUIVALENT.grown]
    return out


def _most_similar(
    equations: NormalEquations, excluded: Sequence[Term]
) -> list[tuple[float, tuple[int, ...]]]:
    """Single effects that predict most of a change, with the share of its square, 0 to 1.

    The rest of the residual is ignored. An effect at another joint may explain more of it, but it
    is no alternative to this effect.

    Args:
        equations: with the change as residual.
        excluded: effects that are left out.
    """
    floor = equations.view.floor
    whole = float((equations.view.mean_square / floor**2).sum())
    out = list[tuple[float, tuple[int, ...]]]()
    for chosen in equations.children(equations.base, EQUIVALENT.single, excluded):
        left = np.mean(equations.structure(chosen).residual ** 2, axis=0)
        out.append((1.0 - float((left / floor**2).sum()) / max(whole, 1e-30), chosen))
    return out


def _select_for_fit(
    removed: Sequence[Term],
    sets: Sequence[Structure],
    evidence: FloatArray,
    possible: Sequence[bool],
) -> list[int]:
    """Indices of the sets that are fitted in the linearized motion.

    These are the best of each size, because the coarse start values favour sets with many
    parameters; as many single effects that may be reported; and single effects that the catalogue
    lists as confused with a removed one.

    Args:
        removed: effects that are replaced.
        sets, evidence, possible: the sets, their evidence, and whether each may be reported.
    """
    out = dict[int, None]()
    order = [int(i) for i in np.argsort(-evidence)]
    for size, count in enumerate(EQUIVALENT.of_size, start=1):
        out.update(dict.fromkeys([i for i in order if len(sets[i].chosen) == size][:count]))
    confused = {e for t in removed for e in t.law.confused_with}
    singles = [i for i in order if len(sets[i].starts) == 1]
    more = [i for i in singles if possible[i] and i not in out]
    out.update(dict.fromkeys(more[: EQUIVALENT.of_size[0]]))
    for i in singles:
        (new,) = sets[i].starts
        if new.effect in confused or any(t.effect in new.law.confused_with for t in removed):
            out[i] = None
    return list(out)


def _with_carried_values(
    problem: Problem, own: Hypothesis, removed: Sequence[Term], other: Hypothesis
) -> list[Hypothesis]:
    """The set ``other`` with values of removed parameters that have the same name and quantity.

    Examples are the same effect at another joint, and delays in another part of the signal path.
    The list is empty if there are no such parameters.
    """
    known = {
        (p.name, p.quantity): float(x) * problem.scales.value(p, t.joint)
        for t in removed
        for p, x in zip(t.parameters, own.theta[own.slice_of(t)], strict=True)
        if not p.choice
    }
    theta, same = other.theta.copy(), False
    for t in other.terms:
        if t in own.terms:
            continue
        at = other.slice_of(t).start
        for k, p in enumerate(t.parameters):
            if (p.name, p.quantity) in known:
                value = known[p.name, p.quantity] / problem.scales.value(p, t.joint)
                theta[at + k], same = np.clip(value, p.lower, p.upper), True
    return [other.with_theta(theta)] if same else []


def without_mere_additions(
    found: Sequence[tuple[float, Hypothesis]], final: Sequence[Term], max_starts: int
) -> list[Hypothesis]:
    """Sets by evidence, at most ``max_starts`` with the same terms.

    Sets that only add new effects to a set that explains nearly as much are left out, because the
    search has decided about the number of effects. Effects of the final set do not count as new.
    """
    known: dict[tuple[Term, ...], float] = {}
    for e, h in found:
        if np.isfinite(e):
            known[h.terms] = max(e, known.get(h.terms, e))
    lowest = min(known.values(), default=0.0)

    def adds(evidence: float, h: Hypothesis) -> bool:
        return np.isfinite(evidence) and any(
            set(terms) < set(h.terms)
            and not set(h.terms) - set(terms) <= set(final)
            and e - lowest >= EQUIVALENT.nearly_all * (evidence - lowest)
            for terms, e in known.items()
            if e > lowest
        )

    return _limit_starts([(e, h) for e, h in found if not adds(e, h)], max_starts)


def _limit_starts(found: Sequence[tuple[float, Hypothesis]], max_starts: int) -> list[Hypothesis]:
    """Hypotheses by evidence, at most ``max_starts`` with the same terms in the same forms."""
    out, seen = list[Hypothesis](), Counter[_Choices]()
    for evidence, h in sorted(found, key=lambda each: -each[0]):
        choices = _choices(h)
        if evidence > -np.inf and seen[choices] < max_starts:
            seen[choices] += 1
            out.append(h)
    return out


_Choices = frozenset[tuple[Term, tuple[float, ...]]]


def _choices(h: Hypothesis) -> _Choices:
    """Terms of a set with their choices."""
    return frozenset(
        (t, tuple(
            float(x) for x, p in zip(h.theta[h.slice_of(t)], t.parameters, strict=True) if p.choice
        ))
        for t in h.terms
    )  # fmt: skip


def _linearized_evidence(
    comparison: ModelComparison, view: ResidualView, own: Hypothesis, fits: Sequence[LinearizedFit]
) -> FloatArray:
    """Evidence of sets relative to the final one, in the linearized motion."""
    everything = [LinearizedFit(own, view.residual), *fits]
    if len(everything) == 1:
        return np.zeros(0)
    residuals = [np.nan_to_num(f.residual) for f in everything]
    effective = view.effective_of_best(residuals)
    closest = min(residuals, key=lambda r: log_misfit(r, view.floor))
    samples = tempered_samples(
        effective, np.mean(closest**2, axis=0), view.floor,
        recordings_of(comparison.problem, fitted=True), len(comparison.problem.joints),
    )  # fmt: skip
    values = np.array([
        log_likelihood(f.residual, NOISE_FLOORS * view.floor, samples)
        - set_penalty(comparison, f.hypothesis, samples)
        for f in everything
    ])  # fmt: skip
    over: FloatArray = np.nan_to_num(values[1:] - values[0], nan=-np.inf)
    return over


def _fit_by_simulation(
    comparison: ModelComparison,
    best: ScoredModel,
    linear: Linearization,
    proposed: Sequence[Hypothesis],
    count: _SimulationCount,
) -> tuple[list[ScoredModel], bool]:
    """Sets fitted by simulation; after each step of the fit fewer sets remain.

    Returns:
        The sets, and whether all steps were done before the time was over.
    """
    problem = best.problem
    weights = comparison.weights(best)
    current, is_complete = list(proposed), True
    if not current:
        return [], True
    residual = problem.residuals(current, problem.fit)
    for step, most in enumerate(EQUIVALENT.kept_by_step):
        max_deficit = EQUIVALENT.far_behind if step else np.inf
        current, residual = _most_likely(comparison, best, current, residual, most, max_deficit)
        slopes = linearized_slopes(linear, current)
        candidates = [
            tie_common_parameters(
                problem,
                propose_step(h, linear.residual(np.nan_to_num(r)), slope, weights, damping),
                h,
            )
            if h.theta.size
            else h
            for h, r, slope in zip(current, residual, slopes, strict=True)
            for damping in _DAMPINGS
        ]
        if count.spent + len(candidates) * count.fitted > EQUIVALENT.most_simulations:
            break
        try:
            found = problem.residuals(candidates, problem.fit)
        except OutOfTime:
            is_complete = False
            break
        for i in range(len(current)):
            mine = range(i * len(_DAMPINGS), (i + 1) * len(_DAMPINGS))
            k = min(mine, key=lambda k: weighted_cost(found[k], weights))
            if weighted_cost(found[k], weights) < weighted_cost(residual[i], weights):
                current[i], residual[i] = candidates[k], found[k]
    held = [best.held_residual] * len(current)
    if comparison.has_validation:
        with comparison.run.budget.reserved():
            held = problem.residuals(current, problem.held_out)
    models = [
        ScoredModel(
            FittedModel(h, r, np.empty((*r.shape, 0)), weighted_cost(r, weights)), other, problem
        )
        for h, r, other in zip(current, residual, held, strict=True)
    ]
    return models, is_complete


def _most_likely(
    comparison: ModelComparison,
    best: ScoredModel,
    hypotheses: Sequence[Hypothesis],
    residuals: Sequence[FloatArray],
    max_sets: int,
    max_deficit: float,
) -> tuple[list[Hypothesis], list[FloatArray]]:
    """The most likely sets by simulation with their residuals, one start of each.

    Sets whose evidence is more than ``max_deficit`` below the final set are left out.
    """
    lengths = comparison.problem.lengths(comparison.problem.fit)
    problem, sets = comparison.problem, [best.hypothesis, *hypotheses]
    residuals_with_tolerance = residuals_with_step_tolerance(
        problem, sets, [best.fitted.residual, *residuals], problem.fit
    )
    values = evidence_on(comparison, sets, residuals_with_tolerance, lengths, fitted=True)[0]
    order = [i for i in np.argsort(-values[1:]) if values[1 + i] > values[0] - max_deficit]
    first = {_choices(hypotheses[i]): int(i) for i in reversed(order)}
    chosen = [int(i) for i in order if first[_choices(hypotheses[i])] == i][:max_sets]
    return [hypotheses[i] for i in chosen], [residuals[i] for i in chosen]


def _rank_sets(
    comparison: ModelComparison,
    best: ScoredModel,
    models: Sequence[ScoredModel],
    linear: Linearization,
    count: _SimulationCount,
    possible: bool,
) -> ComparedSets:
    """The most likely set, and the evidence of the others relative to it."""
    all_models = [best, *models]
    values, tempering = _relative_evidence(comparison, all_models, linear)
    if possible:
        comparison.score_models(models, best)
        values[1:] = [
            _limit_evidence(v, r, best, comparison) for v, r in zip(values[1:], models, strict=True)
        ]
    if not possible and models:
        values[0] = -np.inf
    top = int(np.argmax(values))
    if possible and values[top] <= EQUIVALENT.ahead:
        top = 0
    top = _simplest_of_as_likely(all_models, values, top)
    chosen = all_models[top]
    if top:
        chosen = replace(chosen, problem=comparison.problem.at(chosen.hypothesis))
        (chosen,) = comparison.fit_models(
            [chosen.hypothesis], chosen, RANKING_ITERATIONS, slopes=True
        )
    sets = _other_sets(comparison.problem, all_models, values, top, chosen)
    return ComparedSets(chosen, sets, tempering, count.spent, float(values[top]))


def _rank_unfinished_sets(
    comparison: ModelComparison,
    best: ScoredModel,
    models: Sequence[ScoredModel],
    linear: Linearization,
    count: _SimulationCount,
) -> ComparedSets:
    """The final set, and the evidence of the others as far as they were fitted.

    A set that is not fitted to the end is at most as likely as the final one.
    """
    all_models = [best, *models]
    values, tempering = _relative_evidence(comparison, all_models, linear)
    comparison.score_models(models, best)
    values[1:] = [
        min(_limit_evidence(v, r, best, comparison), 0.0)
        for v, r in zip(values[1:], models, strict=True)
    ]
    sets = _other_sets(comparison.problem, all_models, values, 0, best)
    return ComparedSets(best, sets, tempering, count.spent, is_complete=False)


def _relative_evidence(
    comparison: ModelComparison, all_models: Sequence[ScoredModel], linear: Linearization
) -> tuple[FloatArray, float]:
    """Evidence of sets relative to the first one, and the tempering for model error."""
    idle = idle_parameters(comparison.problem, linear, [r.hypothesis for r in all_models])
    values, tempering = set_evidence(comparison, all_models, idle)
    return values - values[0], tempering


def _other_sets(
    problem: Problem,
    all_models: Sequence[ScoredModel],
    values: FloatArray,
    top: int,
    chosen: ScoredModel,
) -> tuple[AlternativeSet, ...]:
    """The most likely fit of each other set, most likely set first.

    Args:
        all_models: all sets with their fits.
        top: index of the chosen set.
        chosen: the chosen set, fitted to the end.
    """
    likeliest = {
        frozenset(all_models[i].hypothesis.terms): i for i in np.argsort(values, kind="stable")
    }
    sets = [
        AlternativeSet(
            all_models[i],
            float(values[i] - values[top]),
            _prediction_difference(problem, all_models[i], chosen),
        )
        for i in likeliest.values()
        if i != top and np.isfinite(values[i])
    ]
    return tuple(sorted(sets, key=lambda s: -s.evidence))


def _limit_evidence(
    value: float, model: ScoredModel, best: ScoredModel, comparison: ModelComparison
) -> float:
    """Evidence of a set, limited by the search's decision about the number of effects.

    A set with more effects is at most as likely as the final one. A set with fewer effects has the
    penalty of the missing effects if its evidence without tempering is clearly lower.
    """
    mine, other = (set_size(comparison.problem, m.hypothesis).effects for m in (best, model))
    more = other - mine
    if more > 0:
        return min(value, 0.0)
    if more < 0 and model.evidence < -SELECTION.earns:
        return min(value + comparison.penalty_per_effect * more, 0.0)
    return value


def _simplest_of_as_likely(models: Sequence[ScoredModel], values: FloatArray, top: int) -> int:
    """Index of the simplest set among those as likely and as large as the set ``top``.

    It has the fewest parameters, and among these sets the most effects that MJCF can express, so
    that MuJoCo alone can simulate it.
    """

    def inexpressible(i: int) -> int:
        return sum(not mjcf_expresses(t.effect) for t in models[i].hypothesis.terms)

    size = len(models[top].hypothesis.terms)
    alike = [
        i
        for i, r in enumerate(models)
        if len(r.hypothesis.terms) == size and values[i] >= values[top] - EQUIVALENT.ahead
    ]
    return min(alike, key=lambda i: (models[i].hypothesis.free_count, inexpressible(i), i != top))


def _prediction_difference(problem: Problem, one: ScoredModel, other: ScoredModel) -> float:
    return float(
        in_noise_floors(one.fitted.residual - other.fitted.residual, problem.signal_floor).max()
    )
