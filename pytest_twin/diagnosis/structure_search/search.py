"""The search: propose models, simulate them, accept the best, until no proposal passes the test."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.recorded_range import RecordedRange
from pytest_twin.diagnosis.refusal import refused_effects
from pytest_twin.diagnosis.run import Run, ScoredHypothesis
from pytest_twin.diagnosis.search.cost_screen import CostScreen
from pytest_twin.diagnosis.search.linearized_view import (
    LinearizedView,
    linearize_around,
    simulate_around,
)
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.structure_search.proposals import (
    Proposal,
    Quota,
    best_of_each_size,
    has_new_elastic,
    propose_models,
)
from pytest_twin.diagnosis.structure_search.refit import (
    fit_by_simulation,
    fit_with_correction,
    to_fitted_model,
)
from pytest_twin.diagnosis.structure_search.score import Scorer, SimulatedModel
from pytest_twin.diagnosis.structure_search.settings import SETTINGS, StructureSearchSettings
from pytest_twin.diagnosis.structure_search.simulated_proposals import propose_by_simulation
from pytest_twin.diagnosis.trace import Decision
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis


@dataclass(slots=True)
class SearchState:
    """Result of a search.

    Attributes:
        jacobian: (samples, signals, parameters) Jacobian of its last fit.
        rejected_models: rejected models of the last round, with their log-likelihood ratio to
            ``model``.
        was_stopped: whether the callback ``should_stop`` ended the search.
        is_complete: whether it ended because no proposal passes the acceptance test.
    """

    model: SimulatedModel
    jacobian: FloatArray
    rejected_models: list[tuple[SimulatedModel, float]] = field(default_factory=list)
    was_stopped: bool = False
    is_complete: bool = False

    def nearly_as_good(self, max_deficit: float) -> tuple[Hypothesis, ...]:
        """Rivals at most ``max_deficit`` in their log-likelihood ratio, best first."""
        close = [(m, gain) for m, gain in self.rejected_models if gain > -max_deficit]
        return tuple(m.hypothesis for m, _ in sorted(close, key=lambda each: -each[1]))


class StructureSearch:
    """One search over sets of effects for a problem.

    Args:
        run: the diagnosis that the search belongs to.
        should_stop: called with each accepted model; returns whether the search ends.
    """

    def __init__(
        self,
        problem: Problem,
        run: Run | None = None,
        settings: StructureSearchSettings = SETTINGS,
        should_stop: Callable[[SimulatedModel], bool] = lambda model: False,
    ) -> None:
        self.problem = problem
        self.diagnosis_run = Run() if run is None else run
        self.settings = settings
        self.should_stop = should_stop
        self.candidates = candidates(problem)
        self.recorded = RecordedRange.of(problem)
        with self.diagnosis_run.budget.reserved():
            self.scorer = Scorer(problem, len(self.candidates), settings.earns, settings.share)

    def run(self, start: Hypothesis = EMPTY) -> SearchState:
        """Search until no proposal is accepted; the best result so far if time runs out.

        Args:
            start: hypothesis from which the search starts; the nominal model by default.
        """
        result = self._without_fit(self.scorer.nominal)
        try:
            if start.terms:
                # What an earlier search found is the result if no time is left to fit it here.
                with self.diagnosis_run.budget.reserved():
                    result = self._without_fit(self.scorer.simulate_with_own_correction(start))
                model, jacobian = fit_by_simulation(
                    self.scorer, result.model, self.settings.refinements
                )
                result = SearchState(model, jacobian)
            for _ in range(self.settings.rounds):
                improved = self._improve(result)
                if improved is None:
                    return replace(result, is_complete=True)
                result = improved
                if self.should_stop(result.model):
                    return replace(result, was_stopped=True)
        except OutOfTime:
            pass
        return result

    def can_explain(self, share: float) -> bool:
        """Whether some set of effects explains a share of the nominal squared error.

        It is measured in squared noise floors, along the measured motion, without simulations.
        False if no time is left.

        Args:
            share: 0 to 1; at 0 the answer is true without any work.
        """
        if share <= 0.0:
            return True
        nominal, floor = self.scorer.nominal, self.problem.signal_floor
        try:
            found = propose_models(
                self.scorer, self._linearize(self._without_fit(nominal)), self.settings
            )
        except OutOfTime:
            return False
        whole = float(np.sum(np.mean(nominal.residual**2, axis=0) / floor**2))
        left = min((float(np.sum(p.mean_square / floor**2)) for p in found), default=np.inf)
        return left <= (1.0 - share) * whole

    def _linearize(self, result: SearchState) -> LinearizedView:
        model = result.model
        fitted = to_fitted_model(self.problem, model, result.jacobian)
        return linearize_around(ScoredModel(fitted, model.validation, model.problem))

    @staticmethod
    def _without_fit(model: SimulatedModel) -> SearchState:
        return SearchState(model, np.zeros((*model.residual.shape, 0)))

    def _improve(self, result: SearchState) -> SearchState | None:
        """The result of one round; None if no proposal passes the acceptance test.

        Raises:
            OutOfTime: the time is over, and no proposal that was simulated passes the test.
        """
        scorer, incumbent = self.scorer, result.model
        has_effects = bool(incumbent.hypothesis.terms)
        if not has_effects and not scorer.exceeds_floor(incumbent, VERDICT.identifiable).any():
            return None
        models, is_complete = self._simulated_proposals(self._linearize(result), incumbent)
        result.rejected_models = [(m, scorer.gain(m, incumbent)) for m in models]
        winner = self._best_accepted(incumbent, models)
        for model, gain in sorted(result.rejected_models, key=lambda each: -each[1]):
            self._record(model, gain, incumbent, is_accepted=model is winner)
        if winner is incumbent:
            if not is_complete:
                raise OutOfTime
            return None
        try:
            better, jacobian = fit_by_simulation(scorer, winner, self.settings.refinements)
            # Both models are compared with the discretization error at their own parameters.
            refined_incumbent = scorer.simulate_with_own_correction(incumbent.hypothesis)
            corrected = self.problem.at(better.hypothesis)
        except OutOfTime:
            # The winner passed the test by simulation; only its last fit is missing.
            return self._without_fit(winner)
        if not scorer.is_better(better, refined_incumbent):
            gain = scorer.gain(better, refined_incumbent)
            self._record(better, gain, refined_incumbent, is_accepted=False)
            return None
        return SearchState(replace(better, problem=corrected), jacobian)

    def _simulated_proposals(
        self, view: LinearizedView, incumbent: SimulatedModel
    ) -> tuple[list[SimulatedModel], bool]:
        """The most promising proposals, simulated, the best of them fitted.

        Returns:
            The models, and whether all were simulated and fitted before the time was over.

        Raises:
            OutOfTime: the time was over before the proposals were simulated.
        """
        scorer, settings = self.scorer, self.settings
        found = propose_models(scorer, view, settings)
        if self._explains_nothing(found, view):
            seen = simulate_around(view.around, settings.simulated_at_all_sizes)
            found += propose_models(scorer, seen, settings)
        chosen = self._select_proposals(found, incumbent)
        models = scorer.simulate([p.hypothesis for p in chosen], incumbent)
        try:
            models = self._fit_best(view, models, incumbent, settings.finalists)
            best = min(
                [incumbent, *models],
                key=lambda m: float(np.log(np.maximum(m.mean_square, 1e-30)).sum()),
            )
            before = np.nan_to_num(incumbent.mean_square, posinf=0.0)
            left = scorer.exceeds_floor(best, 2.0 * VERDICT.identifiable)
            if (left & (best.mean_square > settings.scan_above * before)).any():
                screen = CostScreen(view.around, view.around.max_mean_square)
                more = propose_by_simulation(scorer, incumbent, best, screen, self.candidates)
                models += self._fit_best(view, scorer.simulate(more, best), incumbent, 3)
        except OutOfTime:
            return models, False
        return models, True

    def _explains_nothing(self, found: Sequence[Proposal], view: LinearizedView) -> bool:
        """Whether the linearization explains nothing of a residual above the noise."""
        own = view.around.hypothesis
        if view.linear is None or own.terms:
            return False
        gains = [p.gain for p in found if not has_new_elastic(p.hypothesis, own)]
        return max(gains, default=0.0) < self.settings.earns

    def _select_proposals(
        self, found: Sequence[Proposal], incumbent: SimulatedModel
    ) -> list[Proposal]:
        """The proposals that are simulated: the best of each number of effects."""
        settings = self.settings
        size = len(incumbent.hypothesis.terms)

        def rank(p: Proposal) -> float:
            # A removed effect must have earned its place, so its removal gets the same amount.
            return p.gain + settings.earns * max(size - len(p.hypothesis.terms), 0)

        ranked = sorted(found, key=rank, reverse=True)
        # Large models can fit errors of the linearization. The best proposals of each number of
        # effects are simulated, so that large ones do not displace a single right effect.
        chosen, others = best_of_each_size(ranked, Quota.of(settings))
        return chosen + others[: max(settings.proposals - len(chosen), 0)]

    def _fit_best(
        self,
        view: LinearizedView,
        models: Sequence[SimulatedModel],
        incumbent: SimulatedModel,
        count: int,
    ) -> list[SimulatedModel]:
        """Models in the order of their gain; the first ``count`` are fitted."""
        scorer = self.scorer
        order = sorted(models, key=lambda m: -scorer.gain(m, incumbent))
        return [
            *fit_with_correction(scorer, view, order[:count], self.settings.corrections),
            *order[count:],
        ]

    def _best_accepted(
        self, incumbent: SimulatedModel, models: Sequence[SimulatedModel]
    ) -> SimulatedModel:
        """The model that passes the acceptance test against all others; smaller ones come first.

        Refused models are left out: those with impossible totals (negative friction or mass), and
        those with shape parameters outside the range of the recordings. Such a model compensates
        for another effect.
        """
        scorer = self.scorer
        order = sorted(
            (m for m in models if not refused_effects(self.problem, m.hypothesis, self.recorded)),
            key=lambda m: (
                len(m.hypothesis.terms),
                m.hypothesis.free_count,
                -scorer.gain(m, incumbent),
            ),
        )
        best = incumbent
        for model in order:
            if scorer.is_better(model, best):
                best = model
        return best

    def _record(
        self, model: SimulatedModel, gain: float, incumbent: SimulatedModel, *, is_accepted: bool
    ) -> None:
        own, terms = set(incumbent.hypothesis.terms), set(model.hypothesis.terms)
        move = "addition" if own <= terms else "removal" if terms < own else "exchange"
        decision: Decision = "accepted" if is_accepted else "rejected"
        reason = (
            "passes the acceptance test, and no simpler proposal does as well"
            if is_accepted
            else self._reason_of_rejection(model, gain, incumbent)
        )
        # A nominal model that diverges has no finite score.
        score = float(np.nan_to_num(self.scorer.gain(incumbent, self.scorer.nominal), posinf=0.0))
        self.diagnosis_run.step(
            self.problem,
            move,
            decision,
            reason,
            ScoredHypothesis(model.hypothesis, score + gain),
            ScoredHypothesis(incumbent.hypothesis, score),
        )

    def _reason_of_rejection(
        self, model: SimulatedModel, gain: float, incumbent: SimulatedModel
    ) -> str:
        if not np.isfinite(gain):
            return "its simulation diverges"
        if refused_effects(self.problem, model.hypothesis, self.recorded):
            return "it needs an impossible total, or parameters outside the range of the recordings"
        if self.scorer.is_better(model, incumbent):
            return "another proposal is simpler or gains more"
        if model.hypothesis.free_count <= incumbent.hypothesis.free_count:
            return f"it scores {gain:+.1f} against the best"
        if gain < self.settings.earns:
            return f"it gains {gain:.1f}; at least {self.settings.earns:g} are needed"
        return "its gain is too small a part of what all effects explain"
