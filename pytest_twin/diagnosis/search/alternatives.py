"""Comparison of each chosen effect with its alternatives.

An alternative is another effect instead of one effect or of several effects of one joint, or their
removal. Alternatives that are close in the linearized motion are fitted by simulation. Their odds
give the confidence of the effect; a better one replaces it.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.recorded_range import RecordedRange
from pytest_twin.diagnosis.refusal import refused_effects
from pytest_twin.diagnosis.search.elimination import EliminationResult, eliminate, have_same_forms
from pytest_twin.diagnosis.search.linearized_view import linearize_around
from pytest_twin.diagnosis.search.listed_rivals import odds_of_listed_rivals, with_listed_rivals
from pytest_twin.diagnosis.search.model_comparison import (
    DECIDING_ITERATIONS,
    RANKING_ITERATIONS,
    ModelComparison,
)
from pytest_twin.diagnosis.search.scored_model import (
    Place,
    ScoredModel,
    SelectedModel,
    compare_below_floor,
)
from pytest_twin.diagnosis.search.settings import SELECTION
from pytest_twin.diagnosis.search.term_exchange import (
    TermExchange,
    better_as_addition,
    better_than_several,
    chance_gain,
    find_exchanges,
    simulated_evidence,
)
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.estimation.score import consistent_evidence_bound


class AlternativeComparison:
    """Compares the effects of a model with their alternatives.

    Attributes:
        comparison: fits and scores the models.
    """

    def __init__(self, comparison: ModelComparison) -> None:
        self.comparison = comparison
        self.problem = comparison.problem
        self.recorded = RecordedRange.of(comparison.problem)

    def exchange(
        self, selected: SelectedModel, simplification_evidence: Mapping[tuple[Term, ...], float]
    ) -> EliminationResult | None:
        """Compare every effect with its alternatives; the better model if there is one.

        Alternatives that are far behind in the linearized motion are not simulated. The confidences
        of ``selected`` are set.

        Args:
            simplification_evidence: terms of a simplification that was simulated -> its evidence.
        """
        best = selected.best
        if not best.hypothesis.terms:
            selected.weigh({})
            return None
        linearized = linearize_around(best)
        penalty = self.comparison.penalty_per_effect
        found = find_exchanges(best, linearized, penalty)
        additions = better_as_addition(best, linearized, found, SELECTION.clear, penalty)
        found = [
            replace(x, evidence=x.evidence - additions[x.new][1]) if x.new in additions else x
            for x in found
        ]
        found = better_than_several(best, linearized, found, additions, penalty)
        simulated = self.simulated_exchanges(best, found, additions)
        found, simulated = self._without_impossible(found, simulated)
        evidence = self.evidence_of_exchanges(best, found, simulated, simplification_evidence)
        selected.weigh(evidence)
        better = [(x, r) for x, r in simulated if evidence[x.removed, x.new] > 1.0]
        top: ScoredModel | None = None
        if better:
            _, first = max(better, key=lambda each: evidence[each[0].removed, each[0].new])
            top = self.exchange_or_addition(best, first)
        elif additions or self.comparison.is_spent(best.hypothesis.terms):
            top = self.best_addition(best, simulated, additions.values())
        if top is not None and refused_effects(self.problem, top.hypothesis, self.recorded):
            top = None
        for x, r in simulated:
            if r is not top:
                why = f"it scores {evidence[x.removed, x.new]:+.1f} against the best"
                self.comparison.record_step("exchange", "rejected", why, r, best)
        if top is None:
            return None
        self.comparison.record_step(
            "exchange", "accepted", f"it gains {top.evidence:.1f}", top, best
        )
        eliminated = eliminate(self.comparison, self.comparison.fit_to_convergence(top))
        if have_same_forms(eliminated.best.hypothesis, best.hypothesis):
            # Exchange and elimination undo each other: both sets explain the recordings equally.
            removed_terms = set(best.hypothesis.terms) - set(top.hypothesis.terms)
            added_terms = set(top.hypothesis.terms) - set(best.hypothesis.terms)
            undone = {
                place for place in evidence
                if place[1] in added_terms and set(place[0]) <= removed_terms
            }  # fmt: skip
            selected.weigh({p: min(e, 0.0) if p in undone else e for p, e in evidence.items()})
            return None
        return eliminated

    def weigh_linearized(
        self, selected: SelectedModel, simplification_evidence: Mapping[tuple[Term, ...], float]
    ) -> None:
        """Set confidences from the linearized comparison alone, in the reserved time.

        No alternative was simulated, so every rival that the catalogue lists gets its share.

        Args:
            selected: the present fit; its confidences are set.
            simplification_evidence: terms of a simplification that was simulated -> its evidence.
        """
        best, terms = selected.best, selected.best.hypothesis.terms
        contact = self.problem.simulator.models.contact.world.size
        if contact or all(t in selected.confidence for t in terms):
            return
        try:
            with self.comparison.run.budget.fitting():
                if best.fitted.jacobian.shape[2] != best.hypothesis.theta.size:
                    best = selected.best = self.comparison.score_without_fit(
                        best.hypothesis, slopes=True
                    )
                best = replace(best, problem=self.problem.at(best.hypothesis))
                linearized = linearize_around(best)
                penalty = self.comparison.penalty_per_effect
                odds = odds_of_listed_rivals(best, linearized, penalty)
                found = [
                    x
                    for x in find_exchanges(best, linearized, penalty)
                    # Only a simulation can compare an elastic transmission with other effects.
                    # Listed rivals count with their own odds.
                    if x.new is None
                    or not (
                        x.new.law.is_elastic_transmission
                        or (len(x.removed) == 1 and x.new in odds[x.removed[0]])
                    )
                ]
                possible, _ = self._without_impossible(found, [])
                evidence = self.evidence_of_exchanges(best, possible, [], simplification_evidence)
        except OutOfTime:
            return
        selected.weigh(evidence)
        weighed = with_listed_rivals(selected, odds)
        selected.confidence, selected.alternatives = weighed.confidence, weighed.alternatives
        selected.not_simulated = frozenset(terms)

    def simulated_exchanges(
        self, best: ScoredModel, found: Sequence[TermExchange], additions: Container[Term | None]
    ) -> list[tuple[TermExchange, ScoredModel]]:
        """Exchanges that are fitted by simulation, with models scored against ``best``.

        For each removed set these are the exchanges with the largest evidence, and those that the
        linearized motion does not judge. When the simulations are used up, only exchanges that seem
        better, and the best candidate instead of several terms, are fitted.

        Args:
            found: exchanges with their linearized evidence.
            additions: candidates that are better as an addition; they are not exchanged.
        """
        spent = self.comparison.is_spent(best.hypothesis.terms)
        near, doubtful, behind = [], [], []
        for place in dict.fromkeys(x.removed for x in found):
            mine = [
                x for x in found
                if x.removed == place and x.new is not None
                and not (x.new in additions and x.evidence < 0.0)
            ]  # fmt: skip
            # Removing several terms loses at least as much as removing the strongest of them.
            removals = [x for x in found if x.new is None and set(x.removed) <= set(place)]
            lost = min((x.evidence for x in removals), default=0.0)
            least = min(-SELECTION.clear, SELECTION.hardly * lost)
            for x in sorted(mine, key=lambda x: -x.evidence)[: SELECTION.close]:
                if x.evidence > (0.0 if spent else least):
                    near.append(x)
                elif x.is_doubtful and (len(place) > 1 or not spent):
                    doubtful.append(x)
                elif len(place) > 1 and x.evidence > least:
                    behind.append(x)
        near += sorted(behind, key=lambda x: -x.evidence)[:1]
        models = self.comparison.fit_models([x.hypothesis for x in near], best, DECIDING_ITERATIONS)
        self.comparison.score_models(models, best)
        models += self.comparison.score_against(
            [x.hypothesis for x in doubtful], best, DECIDING_ITERATIONS, RANKING_ITERATIONS
        )
        models = [self.score_with_own_correction(r, best) for r in models]
        return list(zip([*near, *doubtful], models, strict=True))

    def _without_impossible(
        self, found: Sequence[TermExchange], simulated: Sequence[tuple[TermExchange, ScoredModel]]
    ) -> tuple[list[TermExchange], list[tuple[TermExchange, ScoredModel]]]:
        """Exchanges whose effects can exist, all and the simulated ones.

        An effect with an impossible total is no alternative: it compensates for another effect.
        """
        fitted = {(x.removed, x.new): r.hypothesis for x, r in simulated}
        impossible = {
            (x.removed, x.new)
            for x in found
            if x.new is not None
            and (not x.is_doubtful or (x.removed, x.new) in fitted)
            and refused_effects(
                self.problem, fitted.get((x.removed, x.new), x.hypothesis), self.recorded
            )
        }
        return (
            [x for x in found if (x.removed, x.new) not in impossible],
            [(x, r) for x, r in simulated if (x.removed, x.new) not in impossible],
        )

    def exchange_or_addition(self, best: ScoredModel, top: ScoredModel) -> ScoredModel:
        """An exchange of one term, or the model with both terms if that is better."""
        own, terms = best.hypothesis, top.hypothesis.terms
        removed = [t for t in own.terms if t not in terms]
        if len(removed) != 1 or len(terms) != len(own.terms):
            return top
        both = top.hypothesis.with_term_of(own, removed[0])
        additions = self._fit_and_score(both, self.comparison.weights(best), best)
        return additions if additions.evidence > top.evidence + SELECTION.earns else top

    def best_addition(
        self,
        best: ScoredModel,
        simulated: Sequence[tuple[TermExchange, ScoredModel]],
        additions: Iterable[tuple[Hypothesis, float]],
    ) -> ScoredModel | None:
        """The fit with the clearest candidate in addition, if its evidence is enough; else None.

        Candidates were clearly better in the linearized motion, either in exchange for a term, but
        not in a simulation of that exchange, or as an addition. When the simulations are used up,
        no step forward would add them.

        Args:
            additions: hypotheses with a candidate in addition, and their linearized evidence.
        """
        candidates = [
            (x.hypothesis.with_term_of(best.hypothesis, x.removed[0]), x.evidence)
            for x, _ in simulated
            if len(x.removed) == 1 and x.evidence > SELECTION.clear
        ]
        candidates += [(h, evidence) for h, evidence in additions if evidence > SELECTION.clear]
        if not candidates:
            return None
        candidate, _ = max(candidates, key=lambda each: each[1])
        # The weights are those of a residual at the noise floor: with those of the present residual
        # the fit would ignore the signals that the candidate explains.
        weights = self.problem.weights(np.zeros_like(self.problem.signal_floor))
        model = self._fit_and_score(candidate, weights, best)
        return model if self._gains_enough(model, best) else None

    def _fit_and_score(
        self, start: Hypothesis, weights: FloatArray, best: ScoredModel
    ) -> ScoredModel:
        """A hypothesis, fitted and scored against ``best``."""
        (model,) = self.comparison.fit_models([start], best, DECIDING_ITERATIONS, weights=weights)
        self.comparison.score_models([model], best)
        return model

    def _gains_enough(self, model: ScoredModel, best: ScoredModel) -> bool:
        """Whether a model gains enough over ``best`` to be accepted."""
        comparison = self.comparison
        left = comparison.validation_mean_square(best)
        whole = comparison.mismatch(
            best, comparison.validation_mean_square(comparison.nominal), left
        )
        return (
            model.evidence >= SELECTION.earns
            and (model.held_gain > 0.0 or not comparison.has_validation)
            and comparison.reduces_error_enough(
                left, comparison.validation_mean_square(model), whole
            )
        )

    def score_with_own_correction(self, model: ScoredModel, best: ScoredModel) -> ScoredModel:
        """A model that is behind ``best``, scored again with its own discretization error.

        The discretization error of ``best`` may be the only reason why it is behind.
        """
        least = (
            0.0 if model.hypothesis.free_count < best.hypothesis.free_count else -SELECTION.clear
        )
        if not -SELECTION.disputed < model.evidence < least:
            return model
        own = self.comparison.fit_with_own_correction(model.hypothesis, best)
        self.comparison.score_models([own], best)
        return max(model, own, key=lambda r: r.evidence)

    def evidence_of_exchanges(
        self,
        best: ScoredModel,
        found: Sequence[TermExchange],
        simulated: Sequence[tuple[TermExchange, ScoredModel]],
        simplification_evidence: Mapping[tuple[Term, ...], float],
    ) -> dict[Place, float]:
        """Exchange -> its evidence relative to ``best``, corrected for gains by chance.

        Removals that were simulated have that evidence. If two models explain the same, the one
        with the clearly smaller residual below the noise floor is preferred.
        """
        lost = self._lost_evidence(best, found, [x for x, _ in simulated])
        chance = chance_gain(best.hypothesis, found, self.comparison.sample_ratio, lost)
        supported = [(x, self._supported_evidence(r, best)) for x, r in simulated]
        evidence = simulated_evidence(found, supported)
        evidence = {place: e - chance[place] for place, e in evidence.items()}
        only_terms = best.hypothesis.terms if len(best.hypothesis.terms) == 1 else None
        for x in found:
            without = best.hypothesis.without(*x.removed).terms
            if x.new is None and without in simplification_evidence:
                evidence[x.removed, None] = simplification_evidence[without]
            elif x.new is None and x.removed == only_terms:
                nominal = replace(self.comparison.nominal)
                self.comparison.score_models([nominal], best)
                evidence[x.removed, None] = nominal.evidence
        for (x, r), (_, e) in zip(simulated, supported, strict=True):
            alike = len(x.removed) == 1 and not x.is_generalization and not x.is_special_case
            if not alike or abs(e) >= SELECTION.even:
                continue
            less = compare_below_floor(r, best, self.problem.signal_floor)
            if less:
                evidence[x.removed, x.new] = e + SELECTION.even * less
        return evidence

    def _supported_evidence(self, model: ScoredModel, best: ScoredModel) -> float:
        """Evidence of a model relative to ``best``, limited to what most windows support.

        The limit applies where positions are weighted because of stiction.
        """
        problem = self.problem
        if not problem.position_weights:
            return model.evidence
        mine, others = (np.concatenate([r.fitted.residual, r.held_residual]) for r in (model, best))
        lengths = [*problem.lengths(problem.fit), *problem.lengths(problem.held_out)]
        most = consistent_evidence_bound(mine, others, lengths, problem.signal_floor)
        return float(np.clip(model.evidence, -most, most))

    def _lost_evidence(
        self, best: ScoredModel, found: Sequence[TermExchange], near: Sequence[TermExchange]
    ) -> dict[tuple[Term, ...], float]:
        """Removed term -> evidence that its removal loses in a simulation.

        Only terms with a close alternative that has another number of parameters are removed.
        """
        own = best.hypothesis
        places = {
            x.removed
            for x in near
            if len(x.removed) == 1 and x.hypothesis.free_count != own.free_count
        }
        removals = [x for x in found if x.new is None and x.removed in places]
        if not removals:
            return {}
        models = self.comparison.fit_models([x.hypothesis for x in removals], best, 0)
        self.comparison.score_models(models, best)
        return {x.removed: max(-r.evidence, 0.0) for x, r in zip(removals, models, strict=True)}
