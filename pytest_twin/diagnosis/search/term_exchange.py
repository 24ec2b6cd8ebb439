"""Exchange of chosen effects for others, in the linearized motion.

After the removal of a term, every candidate is fitted to the residual to first order. The best are
fitted with their exact laws, as deviations from the present fit. The removal of an elastic
transmission is simulated, because the linearized motion does not contain it. Several terms of one
joint are also removed together, because two wrong ones may compensate for each other's errors.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import NormalEquations, ResidualView
from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.first_order.linearized_fit import LinearizedFit
from pytest_twin.diagnosis.first_order.sensitivities import Linearization
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.linearized_evidence import (
    fit_and_score_linearized,
    linearized_evidence,
)
from pytest_twin.diagnosis.search.linearized_view import LinearizedView
from pytest_twin.diagnosis.search.scored_model import Place, ScoredModel
from pytest_twin.diagnosis.search.settings import EXCHANGE, SELECTION
from pytest_twin.estimation.hypothesis import Hypothesis, Term


@dataclass(frozen=True, slots=True)
class TermExchange:
    """Another term instead of one or more terms.

    Attributes:
        removed: terms that are removed.
        new: term that replaces them; None for none.
        hypothesis: the result; with fitted parameters if it may be one of the best.
        evidence: relative to the present fit, in the linearized motion.
        is_doubtful: whether the linearized motion does not show the influence of the exchange.
    """

    removed: tuple[Term, ...]
    new: Term | None
    hypothesis: Hypothesis
    evidence: float
    is_doubtful: bool

    @property
    def is_generalization(self) -> bool:
        """Whether the new law contains the removed one as a special case."""
        (one, *more), new = self.removed, self.new
        return new is not None and not more and one.effect in new.law.generalizes

    @property
    def is_special_case(self) -> bool:
        """Whether the new law is a special case of the removed one."""
        (one, *more), new = self.removed, self.new
        return new is not None and not more and new.effect in one.law.generalizes


def find_exchanges(
    best: ScoredModel,
    linearized: LinearizedView,
    penalty_per_effect: float,
) -> list[TermExchange]:
    """The best exchanges of each term, and of several terms of one joint.

    Args:
        penalty_per_effect: penalty of the log-likelihood for each effect.
    """
    terms = best.hypothesis.terms
    singles: list[tuple[Term, ...]] = [(t,) for t in terms]
    found = _exchanges_in_places(
        best, linearized, singles, EXCHANGE.alternatives, penalty_per_effect
    )
    several = _groups_of_joint(terms) if linearized.linear is not None else []
    if several:
        more = _exchanges_in_places(best, linearized, several, 1, penalty_per_effect)
        more = [x for x in more if x.new is not None]
        for is_doubtful in (False, True):
            alike = [x for x in more if x.is_doubtful == is_doubtful]
            found += sorted(alike, key=lambda x: -x.evidence)[: EXCHANGE.alternatives_to_several]
    if linearized.linear is None:
        return found
    near = _indices_to_fit(found)
    fitted, evidence = fit_and_score_linearized(
        linearized.linear,
        linearized.view,
        best,
        [found[i].hypothesis for i in near],
        penalty_per_effect,
    )
    for i, h, value in zip(near, fitted, np.nan_to_num(evidence, nan=-np.inf), strict=True):
        found[i] = replace(found[i], hypothesis=h, evidence=float(value))
    return found


def better_as_addition(
    best: ScoredModel,
    linearized: LinearizedView,
    found: Sequence[TermExchange],
    clear: float,
    penalty_per_effect: float,
) -> dict[Term, tuple[Hypothesis, float]]:
    """Candidates that are clearly better in an exchange, added to the fit instead.

    A candidate that explains another part of the residual is better in exchange for every term and
    is an alternative to none of them. Only its gain over the addition counts for an exchange.

    Args:
        clear: evidence above which an exchange is clearly better.
        penalty_per_effect: penalty of the log-likelihood for each effect.

    Returns:
        Candidate -> the fit with it in addition, and its linearized evidence, which is positive.
    """
    better: dict[Term, TermExchange] = {}
    for x in sorted(found, key=lambda x: x.evidence):
        if x.new is not None and not x.is_doubtful and x.evidence > clear:
            better[x.new] = x
    if linearized.linear is None or not better:
        return {}
    both = [best.hypothesis.with_term_of(x.hypothesis, new) for new, x in better.items()]
    fitted, evidence = fit_and_score_linearized(
        linearized.linear, linearized.view, best, both, penalty_per_effect
    )
    values = np.nan_to_num(evidence, nan=-np.inf)
    return {
        new: (h, float(value))
        for new, h, value in zip(better, fitted, values, strict=True)
        if value > 0.0
    }


def better_than_several(
    best: ScoredModel,
    linearized: LinearizedView,
    found: Sequence[TermExchange],
    additions: Mapping[Term, tuple[Hypothesis, float]],
    penalty_per_effect: float,
) -> list[TermExchange]:
    """Candidates that are clearly better as an addition, tried instead of several terms of a joint.

    Two wrong effects may compensate for each other so well that neither can be exchanged alone. The
    candidate starts from its fit as an addition, because the grid is coarse in shape parameters.

    Args:
        additions: result of :func:`better_as_addition`.
        penalty_per_effect: penalty of the log-likelihood for each effect.

    Returns:
        ``found``, with these exchanges added or replaced.
    """
    several = _groups_of_joint(best.hypothesis.terms)
    places = [
        (removed, new)
        for new in additions
        for removed in several
        if new.joint < 0 or any(t.joint == new.joint for t in removed)
    ]
    if linearized.linear is None or not places:
        return list(found)
    reduced = [additions[new][0].without(*removed) for removed, new in places]
    fitted, evidence = fit_and_score_linearized(
        linearized.linear, linearized.view, best, reduced, penalty_per_effect
    )
    better = {
        place: TermExchange(*place, h, float(e), is_doubtful=False)
        for place, h, e in zip(places, fitted, np.nan_to_num(evidence, nan=-np.inf), strict=True)
        if e > 0.0
    }
    kept = [x for x in found if x.new is None or (x.removed, x.new) not in better]
    return [*kept, *better.values()]


def _indices_to_fit(found: Sequence[TermExchange]) -> list[int]:
    """Indices of the exchanges that may be the best after a fit in the linearized motion."""
    out = []
    for removed in dict.fromkeys(x.removed for x in found):
        mine = [i for i, x in enumerate(found) if x.removed == removed]
        first = max(min(found[i].evidence, 0.0) for i in mine)
        half = EXCHANGE.regained * min(
            (found[i].evidence for i in mine if found[i].new is None), default=0.0
        )
        near = [i for i in mine if found[i].evidence > first - EXCHANGE.near]
        far = [i for i in mine if found[i].new and found[i].evidence > half and i not in near]
        out += near + sorted(far, key=lambda i: -found[i].evidence)[: EXCHANGE.first]
    return out


def chance_gain(
    own: Hypothesis,
    found: Sequence[TermExchange],
    sample_ratio: float = 1.0,
    simulated: Mapping[tuple[Term, ...], float] = MappingProxyType({}),
) -> dict[Place, float]:
    """Evidence that each exchange gains by chance.

    More parameters always follow the residual a little, because it is never white. The value is
    negative for a law with fewer parameters, or for a special case of the one that it replaces.

    Args:
        found: exchanges with their linearized evidence on the fit recordings.
        sample_ratio: number of samples of all recordings divided by that of the fit recordings.
        simulated: removed terms -> evidence that their removal loses in a simulation.
    """
    lost = {x.removed: max(-x.evidence, 0.0) for x in found if x.new is None}
    return {
        (x.removed, x.new): _chance_gain(
            own,
            x,
            lost.get(x.removed, 0.0),
            sample_ratio,
            simulated.get(x.removed, lost.get(x.removed, 0.0)),
        )
        for x in found
    }


def simulated_evidence(
    found: Sequence[TermExchange], simulated: Sequence[tuple[TermExchange, float]]
) -> dict[Place, float]:
    """Exchange -> its evidence relative to the present fit.

    It is that of the simulation if there was one. Else it is the linearized evidence, minus the
    smallest loss between linearization and simulation among exchanges of the same terms.

    Args:
        found: all exchanges.
        simulated: the simulated ones with their evidence.
    """
    evidence = {(x.removed, x.new): x.evidence for x in found}
    reliable = [(x, e) for x, e in simulated if not x.is_doubtful]
    for removed in dict.fromkeys(x.removed for x, _ in reliable):
        lost = min(x.evidence - e for x, e in reliable if x.removed == removed)
        for x in found:
            if x.removed == removed and x.new is not None and not x.is_doubtful:
                evidence[removed, x.new] -= max(lost, 0.0)
    return evidence | {(x.removed, x.new): e for x, e in simulated}


def _chance_gain(
    own: Hypothesis, exchange: TermExchange, lost: float, sample_ratio: float, simulated: float
) -> float:
    """As :func:`chance_gain`, for one exchange; ``lost`` is linearized, ``simulated`` simulated."""
    if exchange.new is None:
        return 0.0
    # Errors of the simulator are in all recordings. A fit only follows those of the fit recordings.
    if exchange.is_generalization:
        return EXCHANGE.general_ahead * lost * sample_ratio
    if exchange.is_special_case:
        return -EXCHANGE.special_behind * lost * sample_ratio
    more = exchange.hypothesis.free_count - own.free_count
    if more < 0 and len(exchange.removed) > 1:
        return 0.0
    return float(np.sign(more)) * min(SELECTION.as_good * simulated, EXCHANGE.chance)


def _exchanges_in_places(
    best: ScoredModel,
    linearized: LinearizedView,
    places: Sequence[tuple[Term, ...]],
    count: int,
    penalty_per_effect: float,
) -> list[TermExchange]:
    """For each removed set: no term and the ``count`` best candidates, to first order."""
    own, view = best.hypothesis, linearized.view
    reduced = [own.without(*removed) for removed in places]
    removes_elastic = [any(t.law.is_elastic_transmission for t in removed) for removed in places]
    out = []
    residuals = _residuals_of(best.problem, linearized.linear, view, reduced, removes_elastic)
    for removed, rest, gear, left in zip(places, reduced, removes_elastic, residuals, strict=True):
        slope = view.jacobian[:, :, own.parameters_without(*removed)]
        equations = NormalEquations(
            ResidualView(left, slope, view.floor, view.lengths),
            linearized.candidate_sensitivities,
        )
        chosen = equations.children(equations.base, count, rest.terms)
        structures = [equations.base, *(equations.structure(c) for c in chosen)]
        hypotheses = [rest.with_terms(s.starts) for s in structures]
        linear_fits = [
            LinearizedFit(h, s.residual) for h, s in zip(hypotheses, structures, strict=True)
        ]
        values = linearized_evidence(
            view, [LinearizedFit(own, view.residual), *linear_fits], penalty_per_effect
        )
        values = np.nan_to_num(values, nan=-np.inf)
        far = bool(view.is_above(np.mean(left**2, axis=0), EXCHANGE.far_apart).any())
        for s, h, value in zip(structures, hypotheses, values[1:] - values[0], strict=True):
            new = next(iter(s.starts), None)
            is_doubtful = far and new is not None and (gear or linearized.linear is None)
            out.append(TermExchange(removed, new, h, float(value), is_doubtful))
    return out


def _residuals_of(
    problem: Problem,
    linear: Linearization | None,
    view: ResidualView,
    reduced: Sequence[Hypothesis],
    removes_elastic: Sequence[bool],
) -> list[FloatArray]:
    """(bins, signals) residual of each reduced model.

    It is simulated if an elastic transmission was removed or the problem has no linearization.
    """
    simulated = [k for k, gear in enumerate(removes_elastic) if gear or linear is None]
    not_simulated = [k for k in range(len(reduced)) if k not in simulated]
    out: dict[int, FloatArray] = {}
    if simulated:
        binned = bins(problem, problem.fit)
        found = problem.residuals([reduced[k] for k in simulated], problem.fit)
        out = {k: binned.mean(np.nan_to_num(r)) for k, r in zip(simulated, found, strict=True)}
    if not_simulated and linear is not None:
        differences = linear.differences([reduced[k] for k in not_simulated])
        out |= {k: view.residual - d for k, d in zip(not_simulated, differences, strict=True)}
    return [np.nan_to_num(out[k]) for k in range(len(reduced))]


def residuals_without(
    problem: Problem,
    linear: Linearization,
    view: ResidualView,
    own: Hypothesis,
    places: Sequence[tuple[Term, ...]],
) -> list[FloatArray]:
    """(bins, signals) residual of a fit without each of several sets of its terms.

    The other parameters are not fitted again. The residual is simulated if an elastic transmission
    is removed, else it is linearized.
    """
    removes_elastic = [any(t.law.is_elastic_transmission for t in removed) for removed in places]
    reduced = [own.without(*removed) for removed in places]
    return _residuals_of(problem, linear, view, reduced, removes_elastic)


def _groups_of_joint(terms: Sequence[Term]) -> list[tuple[Term, ...]]:
    """Sets of terms that are removed together: of one joint, with rigid-body terms of the robot."""
    out: dict[tuple[Term, ...], None] = {}
    for joint in {t.joint for t in terms if t.joint >= 0}:
        removable = [
            t for t in terms
            if t.joint == joint or (t.joint < 0 and t.law.family == "rigid_body")
        ]  # fmt: skip
        sizes = (
            range(2, len(removable) + 1)
            if len(removable) <= EXCHANGE.crowd
            else (2, len(removable))
        )
        for size in sizes:
            out.update(dict.fromkeys(itertools.combinations(removable, size)))
    return list(out)
