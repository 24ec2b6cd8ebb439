"""Exchange of chosen effects for others, in the linearized motion.

Without a term, every candidate is compared with the residual, to first order. The best are fitted
as deviations from the present fit, where the term itself is exact and similar effects differ
little. An elastic transmission is removed by simulation: the linearized motion does not show what
it does. Several terms of one joint are removed together too, because two wrong ones may compensate
for each other's errors.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import (
    CandidateSensitivities,
    NormalEquations,
    ResidualView,
)
from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.first_order.linearized_fit import LinearizedFit
from pytest_twin.diagnosis.first_order.sensitivities import Linear, Sensitivity
from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.linearized_shortlist import (
    fit_and_score_linearized,
    linearized_evidence,
)
from pytest_twin.diagnosis.search.linearized_view import LinearizedView
from pytest_twin.diagnosis.search.scored_model import Place, ScoredModel
from pytest_twin.diagnosis.search.settings import EXCHANGE, SELECTION


@dataclass(frozen=True, slots=True)
class TermExchange:
    """Something else instead of one or more terms.

    Attributes:
        gone: what was taken away.
        new: what stands there; None for nothing.
        hypothesis: fitted along the motion, where that may be in front.
        evidence: over the fit at hand, along the motion.
        doubtful: whether the linearized motion does not show its effect.
    """

    gone: tuple[Term, ...]
    new: Term | None
    hypothesis: Hypothesis
    evidence: float
    doubtful: bool

    @property
    def is_generalization(self) -> bool:
        """Whether what is new has the one that is gone in it."""
        (one, *more), new = self.gone, self.new
        return new is not None and not more and one.effect in new.law.generalizes

    @property
    def is_special_case(self) -> bool:
        """Whether what is new is a special case of the one that is gone."""
        (one, *more), new = self.gone, self.new
        return new is not None and not more and new.effect in one.law.generalizes


def find_exchanges(
    problem: Problem,
    best: ScoredModel,
    look: LinearizedView,
    known: Mapping[Term, Sequence[Sensitivity]],
    name_price: float,
) -> list[TermExchange]:
    """Everything near that could stand instead of a term, or of several of one joint.

    Args:
        problem: what to explain.
        best: the fit at hand.
        look: around it.
        known: responses of terms that are named by now, from looks before they were.
        name_price: evidence that a name costs.
    """
    terms = best.hypothesis.terms
    singles: list[tuple[Term, ...]] = [(t,) for t in terms]
    found = _places(problem, best, look, look.answers, singles, EXCHANGE.alternatives, name_price)
    several = _together(terms) if look.linear is not None else []
    if several:
        again = [r for t in terms for r in known.get(t, ())]
        answers = CandidateSensitivities([*look.answers.responses, *again])
        more = _places(problem, best, look, answers, several, 1, name_price)
        more = [x for x in more if x.new is not None]
        for doubtful in (False, True):
            alike = [x for x in more if x.doubtful == doubtful]
            found += sorted(alike, key=lambda x: -x.evidence)[: EXCHANGE.alternatives_to_several]
    if look.linear is None:
        return found
    near = _worth_fitting(found)
    fitted, evidence = fit_and_score_linearized(
        look.linear, look.view, best, [found[i].hypothesis for i in near], name_price
    )
    for i, h, value in zip(near, fitted, np.nan_to_num(evidence, nan=-np.inf), strict=True):
        found[i] = replace(found[i], hypothesis=h, evidence=float(value))
    return found


def better_as_addition(
    best: ScoredModel,
    look: LinearizedView,
    found: Sequence[TermExchange],
    clear: float,
    name_price: float,
) -> dict[Term, tuple[Hypothesis, float]]:
    """What is clearly better instead of something, beside everything: fitted along the motion,
    with its evidence over the fit at hand.

    What explains something else is better in every place, and a rival of nothing: it stands in a
    place as far as it is better there than beside what is there.

    Args:
        best: the fit at hand.
        look: around it.
        found: what could stand in the places of its terms.
        clear: evidence beyond which something is clearly better.
        name_price: evidence that a name costs.
    """
    better: dict[Term, TermExchange] = {}
    for x in sorted(found, key=lambda x: x.evidence):
        if x.new is not None and not x.doubtful and x.evidence > clear:
            better[x.new] = x
    if look.linear is None or not better:
        return {}
    both = [best.hypothesis.with_term_of(x.hypothesis, new) for new, x in better.items()]
    fitted, evidence = fit_and_score_linearized(look.linear, look.view, best, both, name_price)
    values = np.nan_to_num(evidence, nan=-np.inf)
    return {
        new: (h, float(value))
        for new, h, value in zip(better, fitted, values, strict=True)
        if value > 0.0
    }


def better_than_several(
    best: ScoredModel,
    look: LinearizedView,
    found: Sequence[TermExchange],
    beside: Mapping[Term, tuple[Hypothesis, float]],
    name_price: float,
) -> list[TermExchange]:
    """Candidates that are clearly better as an addition, tried instead of several terms of a joint.

    Two wrong effects may compensate for each other so well that neither can be exchanged alone. As
    an addition the candidate was fitted; a grid knows little of the shape of a non-linear law.

    Args:
        best: the fit at hand.
        look: around it.
        found: what could stand in the places of its terms.
        beside: as :func:`better_as_addition` has it.
        name_price: evidence that a name costs.

    Returns:
        ``found``, with these instead of the same as they were before.
    """
    several = _together(best.hypothesis.terms)
    places = [
        (gone, new)
        for new in beside
        for gone in several
        if new.joint < 0 or any(t.joint == new.joint for t in gone)
    ]
    if look.linear is None or not places:
        return list(found)
    rests = [beside[new][0].without(*gone) for gone, new in places]
    fitted, evidence = fit_and_score_linearized(look.linear, look.view, best, rests, name_price)
    better = {
        place: TermExchange(*place, h, float(e), doubtful=False)
        for place, h, e in zip(places, fitted, np.nan_to_num(evidence, nan=-np.inf), strict=True)
        if e > 0.0
    }
    kept = [x for x in found if x.new is None or (x.gone, x.new) not in better]
    return [*kept, *better.values()]


def _worth_fitting(found: Sequence[TermExchange]) -> list[int]:
    """Numbers of those that may be in front once they are fitted along the motion."""
    out = []
    for gone in dict.fromkeys(x.gone for x in found):
        mine = [i for i, x in enumerate(found) if x.gone == gone]
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
    unseen: float = 1.0,
    simulated: Mapping[tuple[Term, ...], float] = MappingProxyType({}),
) -> dict[Place, float]:
    """Evidence that each exchange gains by chance.

    More parameters always follow the residual a little, because it is never white. The value is
    negative for a law with fewer parameters, or for a special case of the one that it replaces.

    Args:
        own: the fit at hand.
        found: evidence along the motion, of what was fitted.
        unseen: times as much evidence as that is of all recordings, also of what no fit sees.
        simulated: evidence that is lost without each, where that was simulated: along the motion
            samples hang together for longer, and evidence is less.
    """
    lost = {x.gone: max(-x.evidence, 0.0) for x in found if x.new is None}
    return {
        (x.gone, x.new): _by_chance(
            own, x, lost.get(x.gone, 0.0), unseen, simulated.get(x.gone, lost.get(x.gone, 0.0))
        )
        for x in found
    }


def simulated_evidence(
    found: Sequence[TermExchange], simulated: Sequence[tuple[TermExchange, float]]
) -> dict[Place, float]:
    """Evidence of each over the fit at hand: simulated, or along the motion less what simulation
    took at least off those that seemed nearer in the same place.

    Args:
        found: all of them.
        simulated: those that were, with the evidence that they came to.
    """
    evidence = {(x.gone, x.new): x.evidence for x in found}
    told = [(x, e) for x, e in simulated if not x.doubtful]
    for gone in dict.fromkeys(x.gone for x, _ in told):
        lost = min(x.evidence - e for x, e in told if x.gone == gone)
        for x in found:
            if x.gone == gone and x.new is not None and not x.doubtful:
                evidence[gone, x.new] -= max(lost, 0.0)
    return evidence | {(x.gone, x.new): e for x, e in simulated}


def _by_chance(
    own: Hypothesis, exchange: TermExchange, lost: float, unseen: float, simulated: float
) -> float:
    if exchange.new is None:
        return 0.0
    # What a simulator does otherwise shows in all recordings; no fit follows what it has not seen.
    if exchange.is_generalization:
        return EXCHANGE.general_ahead * lost * unseen
    if exchange.is_special_case:
        return -EXCHANGE.special_behind * lost * unseen
    more = exchange.hypothesis.free - own.free
    if more < 0 and len(exchange.gone) > 1:
        return 0.0
    return float(np.sign(more)) * min(SELECTION.as_good * simulated, EXCHANGE.chance)


def _places(
    problem: Problem,
    best: ScoredModel,
    look: LinearizedView,
    answers: CandidateSensitivities,
    places: Sequence[tuple[Term, ...]],
    count: int,
    name_price: float,
) -> list[TermExchange]:
    """Nothing, and the ``count`` best candidates, in each of several places, to first order."""
    own, view = best.hypothesis, look.view
    rests = [own.without(*gone) for gone in places]
    gears = [any(t.law.is_elastic_transmission for t in gone) for gone in places]
    out = []
    lefts = _left_of(problem, look.linear, view, rests, gears)
    for gone, rest, gear, left in zip(places, rests, gears, lefts, strict=True):
        slope = view.jacobian[:, :, own.parameters_without(*gone)]
        lens = NormalEquations(ResidualView(left, slope, view.floor, view.lengths), answers)
        chosen = lens.children(lens.bare, count, rest.terms)
        structures = [lens.bare, *(lens.structure(c) for c in chosen)]
        hypotheses = [rest.with_terms(s.starts) for s in structures]
        seen = [LinearizedFit(h, s.residual) for h, s in zip(hypotheses, structures, strict=True)]
        values = linearized_evidence(view, [LinearizedFit(own, view.residual), *seen], name_price)
        values = np.nan_to_num(values, nan=-np.inf)
        far = bool(view.above(np.mean(left**2, axis=0), EXCHANGE.far_apart).any())
        for s, h, value in zip(structures, hypotheses, values[1:] - values[0], strict=True):
            new = next(iter(s.starts), None)
            doubtful = far and new is not None and (gear or look.linear is None)
            out.append(TermExchange(gone, new, h, float(value), doubtful))
    return out


def _left_of(
    problem: Problem,
    linear: Linear | None,
    view: ResidualView,
    rests: Sequence[Hypothesis],
    gears: Sequence[bool],
) -> list[FloatArray]:
    """(bins, signals) that each of the rests leaves: simulated without gears and where nothing is
    of first order, else along the motion.
    """
    simulated = [k for k, gear in enumerate(gears) if gear or linear is None]
    along = [k for k in range(len(rests)) if k not in simulated]
    out: dict[int, FloatArray] = {}
    if simulated:
        binned = bins(problem, problem.fit)
        found = problem.residuals([rests[k] for k in simulated], problem.fit)
        out = {k: binned.mean(np.nan_to_num(r)) for k, r in zip(simulated, found, strict=True)}
    if along and linear is not None:
        differences = linear.differences([rests[k] for k in along])
        out |= {k: view.residual - d for k, d in zip(along, differences, strict=True)}
    return [np.nan_to_num(out[k]) for k in range(len(rests))]


def residuals_without(
    problem: Problem,
    linear: Linear,
    view: ResidualView,
    own: Hypothesis,
    places: Sequence[tuple[Term, ...]],
) -> list[FloatArray]:
    """(bins, signals) that a fit leaves without each of several subsets of its terms, the others as
    they are: simulated where a gear goes, else along the motion.
    """
    gears = [any(t.law.is_elastic_transmission for t in gone) for gone in places]
    rests = [own.without(*gone) for gone in places]
    return _left_of(problem, linear, view, rests, gears)


def _together(terms: Sequence[Term]) -> list[tuple[Term, ...]]:
    """Terms of one joint that are taken away together, bodies of the whole robot with them."""
    out: dict[tuple[Term, ...], None] = {}
    for joint in {t.joint for t in terms if t.joint >= 0}:
        crowd = [
            t for t in terms
            if t.joint == joint or (t.joint < 0 and t.law.family == "rigid_body")
        ]  # fmt: skip
        sizes = range(2, len(crowd) + 1) if len(crowd) <= EXCHANGE.crowd else (2, len(crowd))
        for size in sizes:
            out.update(dict.fromkeys(itertools.combinations(crowd, size)))
    return list(out)
