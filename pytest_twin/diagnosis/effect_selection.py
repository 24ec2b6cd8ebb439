"""Selection of effects: the structure search, backward elimination, comparison with alternatives.

The structure search finds a set of effects (:mod:`structure_search`). Effects that do not pay their
penalty are removed from it (:mod:`elimination`), and each of the others is compared with its
alternatives (:mod:`alternatives`). If one of these is better, the structure search continues from
it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.refusal import refused_effects
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search.alternatives import AlternativeComparison
from pytest_twin.diagnosis.search.drive_limits import doubtful_limits, replace_limits
from pytest_twin.diagnosis.search.elimination import eliminate
from pytest_twin.diagnosis.search.model_comparison import DECIDING_ITERATIONS, ModelComparison
from pytest_twin.diagnosis.search.noise_levels import in_noise_floors
from pytest_twin.diagnosis.search.scored_model import ScoredModel, SelectedModel
from pytest_twin.diagnosis.search.settings import SELECTION
from pytest_twin.diagnosis.structure_search.score import SimulatedModel
from pytest_twin.diagnosis.structure_search.search import SearchState, StructureSearch
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term

# Log-likelihood ratio by which other sets of the structure search may be behind to share the
# confidence of its result: odds of 1 to 22,000.
_NEARLY_AS_GOOD = 10.0


class EffectSelection:
    """One selection of effects for a problem.

    Attributes:
        comparison: fits and scores the models.
        alternatives: compares effects with their alternatives.
        was_stopped: whether the search ended because ``should_stop`` was true.
        is_complete: whether the structure search has nothing to add to the present fit.
        nearly_as_good: sets that the last structure search found nearly as good as its result.
        tested_limits: limits of drives that were compared with others.
        simplification_evidence: terms of a simplification that was simulated -> its evidence.
    """

    def __init__(
        self,
        problem: Problem,
        run: Run | None = None,
        max_residual_share: float = 1.0,
        should_stop: Callable[[SimulatedModel], bool] = lambda model: False,
    ) -> None:
        """Set up a selection among all sets of effects.

        Args:
            max_residual_share: largest share of the nominal squared error that may remain. Below
                1, the nominal model is kept if no set leaves less in the linearized motion.
            should_stop: whether the search ends at a model; called after each step of the first
                search.
        """
        self.problem = problem
        self.diagnosis_run = Run() if run is None else run
        self.max_residual_share = max_residual_share
        self.should_stop = should_stop
        self.comparison = ModelComparison(problem, self.diagnosis_run)
        self.alternatives = AlternativeComparison(self.comparison)
        self.was_stopped = False
        self.is_complete = False
        self.nearly_as_good: tuple[Hypothesis, ...] = ()
        self.tested_limits: set[Term] = set()
        self.simplification_evidence: Mapping[tuple[Term, ...], float] = MappingProxyType({})

    def run(self, start: Hypothesis = EMPTY) -> SelectedModel:
        """Select effects from the nominal model or from a hypothesis; the best so far if time ends.

        Args:
            start: hypothesis from which the structure search starts.
        """
        search = StructureSearch(self.problem, self.diagnosis_run, should_stop=self.should_stop)
        if not start.terms and not search.can_explain(1.0 - self.max_residual_share):
            return self._as_selected(self.comparison.nominal)
        found = search.run(start)
        with self.diagnosis_run.budget.reserved():
            best = self.comparison.score_without_fit(found.model.hypothesis, slopes=True)
        if found.was_stopped:
            self.was_stopped = True
            return self._as_selected(best)
        self._store_result(found)
        return self.refine(best)

    def refine(self, best: ScoredModel) -> SelectedModel:
        """Remove and exchange effects of a fit, and add those that the structure search finds."""
        selected = self._as_selected(best)
        try:
            selected.best = self._eliminate(best)
            self._improve(selected)
        except OutOfTime:
            self.alternatives.weigh_linearized(selected, self.simplification_evidence)
            stage = self.diagnosis_run.trace.stage
            self.diagnosis_run.skip(f"the search over {stage} (begun, not finished)")
            self.comparison.record_step("search", "ended", "the time is over", None, selected.best)
        selected.nearly_as_good = self.nearly_as_good
        return selected

    def simplify(self, best: ScoredModel) -> SelectedModel:
        """As :meth:`refine`, but effects are added only after an exchange."""
        self.is_complete = True
        return self.refine(best)

    def _as_selected(self, best: ScoredModel) -> SelectedModel:
        return SelectedModel(
            best, self.comparison.nominal, candidate_count=self.comparison.candidate_count
        )

    def _store_result(self, found: SearchState) -> None:
        self.is_complete = found.is_complete
        self.nearly_as_good = found.nearly_as_good(_NEARLY_AS_GOOD)

    def _eliminate(self, best: ScoredModel) -> ScoredModel:
        """The best fit after backward elimination; the losses of its simplifications are kept."""
        eliminated = eliminate(self.comparison, best)
        self.simplification_evidence = eliminated.simplification_evidence
        return eliminated.best

    def _improve(self, selected: SelectedModel) -> None:
        """Exchange, add and remove effects until no change is better."""
        for _ in range(SELECTION.rounds):
            better = self.exchange_limits(selected.best) or self._extend(selected.best)
            if better is not None:
                selected.best = better
                selected.best = self._eliminate(better)
                if self._implausible_terms(selected.best):
                    break
                continue
            exchanged = self.alternatives.exchange(selected, self.simplification_evidence)
            if exchanged is None:
                break
            selected.best, self.simplification_evidence = (
                exchanged.best,
                exchanged.simplification_evidence,
            )
            self.is_complete = False

    def _extend(self, best: ScoredModel) -> ScoredModel | None:
        """A better fit by the structure search; None if it finds none."""
        terms = best.hypothesis.terms
        if (
            self.is_complete
            or len(terms) >= SELECTION.most_terms
            or self.comparison.is_spent(terms)
            or not self.comparison.has_residual_to_explain(best)
        ):
            return None
        found = StructureSearch(self.problem, self.diagnosis_run).run(best.hypothesis)
        self._store_result(found)
        if set(found.model.hypothesis.terms) == set(terms):
            return None
        return self.comparison.score_without_fit(found.model.hypothesis, slopes=True)

    def exchange_limits(self, best: ScoredModel) -> ScoredModel | None:
        """Another limit of a drive instead of the chosen one, if it is clearly better.

        Each limit is tested once.
        """
        limits = doubtful_limits(best)
        new = [t for t in limits if t not in self.tested_limits]
        self.tested_limits.update(new)
        others = replace_limits(best, new) if new else []
        if not others:
            return None
        top = max(
            self.comparison.score_against(others, best, DECIDING_ITERATIONS),
            key=lambda r: r.evidence,
        )
        if top.evidence <= SELECTION.clear:
            return None
        self.comparison.record_step(
            "other limit", "accepted", f"it gains {top.evidence:.1f}", top, best
        )
        return self.comparison.fit_to_convergence(top)

    def _implausible_terms(self, model: ScoredModel) -> list[Term]:
        """Effects that compensate for another effect.

        They are at a physical bound while their joint stays unexplained, or their values are
        impossible or outside the range of the recordings.
        """
        problem, hypothesis = self.problem, model.hypothesis
        excluded = refused_effects(problem, hypothesis, self.alternatives.recorded)
        left = in_noise_floors(model.fitted.residual, problem.signal_floor)[: len(problem.joints)]
        return [
            t for t in hypothesis.terms
            if t in excluded
            or (
                hypothesis.is_at_bound(t)
                and (left.max() if t.joint < 0 else left[t.joint]) > VERDICT.left_floors
            )
        ]  # fmt: skip
