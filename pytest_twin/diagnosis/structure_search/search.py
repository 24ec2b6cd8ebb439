"""The search: propose models, simulate them, accept the best, until no proposal passes the test."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.deadline import OutOfTime
from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.recorded_range import RecordedRange
from pytest_twin.diagnosis.refusal import refused
from pytest_twin.diagnosis.run import Run, Scored
from pytest_twin.diagnosis.search.linearized_view import (
    LinearizedView,
    linearize_around,
    simulate_around,
)
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search.trial_simulation import TrialSimulation
from pytest_twin.diagnosis.structure_search.proposals import (
    Proposal,
    Quota,
    best_of_each_size,
    has_new_elastic,
    proposals,
)
from pytest_twin.diagnosis.structure_search.refit import (
    as_fitted,
    corrected_fits,
    fit_by_simulation,
)
from pytest_twin.diagnosis.structure_search.score import Model, Scorer
from pytest_twin.diagnosis.structure_search.settings import SETTINGS, StructureSearchSettings
from pytest_twin.diagnosis.structure_search.simulated_proposals import simulated_proposals
from pytest_twin.diagnosis.trace import Decision
from pytest_twin.diagnosis.verdict_settings import VERDICT


@dataclass(slots=True)
class Result:
    """Result of a search.

    Attributes:
        model: the accepted model.
        jacobian: (samples, signals, parameters) Jacobian of its last fit.
        rivals: rejected models of the last round, with their log-likelihood ratio to ``model``.
        has_left: whether the callback ``leave`` ended the search.
        is_complete: whether it ended because no proposal passes the acceptance test.
    """

    model: Model
    jacobian: FloatArray
    rivals: list[tuple[Model, float]] = field(default_factory=list)
    has_left: bool = False
    is_complete: bool = False

    def nearly_as_good(self, behind: float) -> tuple[Hypothesis, ...]:
        """Rivals at most ``behind`` in their log-likelihood ratio, best first."""
        close = [(m, gain) for m, gain in self.rivals if gain > -behind]
        return tuple(m.hypothesis for m, _ in sorted(close, key=lambda each: -each[1]))


class StructureSearch:
    """One search over sets of effects for a problem.

    Args:
        problem: the problem.
        run: the diagnosis that the search belongs to.
        settings: thresholds and bounds.
        leave: called with each accepted model; returns whether the search ends.
    """

    def __init__(
        self,
        problem: Problem,
        run: Run | None = None,
        settings: StructureSearchSettings = SETTINGS,
        leave: Callable[[Model], bool] = lambda model: False,
    ) -> None:
        self.problem = problem
        self.diagnosis_run = Run() if run is None else run
        self.settings = settings
        self.leave = leave
        self.candidates = candidates(problem)
        self.recorded = RecordedRange.of(problem)
        with self.diagnosis_run.budget.reserved():
            self.scorer = Scorer(problem, len(self.candidates), settings.earns, settings.share)

    def run(self, start: Hypothesis = EMPTY) -> Result:
        """Search until no proposal is accepted; the best result so far if time runs out.

        Args:
            start: hypothesis from which the search starts; the nominal model by default.
        """
        result = self._without_fit(self.scorer.nominal)
        try:
            if start.terms:
                # What an earlier search found is the result if no time is left to fit it here.
                with self.diagnosis_run.budget.reserved():
                    result = self._without_fit(self.scorer.at(start))
                model, jacobian = fit_by_simulation(
                    self.scorer, result.model, self.settings.refinements
                )
                result = Result(model, jacobian)
            for _ in range(self.settings.rounds):
                improved = self._improved(result)
                if improved is None:
                    return replace(result, is_complete=True)
                result = improved
                if self.leave(result.model):
                    return replace(result, has_left=True)
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
            found = proposals(self.scorer, self._view(self._without_fit(nominal)), self.settings)
        except OutOfTime:
            return False
        whole = float(np.sum(np.mean(nominal.residual**2, axis=0) / floor**2))
        left = min((float(np.sum(p.left / floor**2)) for p in found), default=np.inf)
        return left <= (1.0 - share) * whole

    def _view(self, result: Result) -> LinearizedView:
        model = result.model
        fitted = as_fitted(self.problem, model, result.jacobian)
        return linearize_around(ScoredModel(fitted, model.validation, model.problem))

    @staticmethod
    def _without_fit(model: Model) -> Result:
        return Result(model, np.zeros((*model.residual.shape, 0)))

    def _improved(self, result: Result) -> Result | None:
        """The result of one round; None if no proposal passes the acceptance test.

        Raises:
            OutOfTime: the time is over, and no proposal that was simulated passes the test.
        """
        scorer, incumbent = self.scorer, result.model
        has_effects = bool(incumbent.hypothesis.terms)
        if not has_effects and not scorer.exceeds_floor(incumbent, VERDICT.identifiable).any():
            return None
        models, is_complete = self._simulated_proposals(self._view(result), incumbent)
        result.rivals = [(m, scorer.gain(m, incumbent)) for m in models]
        winner = self._winner(incumbent, models)
        for model, gain in sorted(result.rivals, key=lambda each: -each[1]):
            self._record(model, gain, incumbent, taken=model is winner)
        if winner is incumbent:
            if not is_complete:
                raise OutOfTime
            return None
        try:
            better, jacobian = fit_by_simulation(scorer, winner, self.settings.refinements)
            # Both models are compared with the discretization error at their own parameters.
            refined_incumbent = scorer.at(incumbent.hypothesis)
            corrected = self.problem.at(better.hypothesis)
        except OutOfTime:
            # The winner passed the test by simulation; only its last fit is missing.
            return self._without_fit(winner)
        if not scorer.is_better(better, refined_incumbent):
            gain = scorer.gain(better, refined_incumbent)
            self._record(better, gain, refined_incumbent, taken=False)
            return None
        return Result(replace(better, problem=corrected), jacobian)

    def _simulated_proposals(
        self, view: LinearizedView, incumbent: Model
    ) -> tuple[list[Model], bool]:
        """The most promising proposals, simulated, the best of them fitted.

        Returns:
            The models, and whether all were simulated and fitted before the time was over.

        Raises:
            OutOfTime: the time was over before the proposals were simulated.
        """
        scorer, settings = self.scorer, self.settings
        found = proposals(scorer, view, settings)
        if self._explains_nothing(found, view):
            seen = simulate_around(view.around, settings.simulated_at_all_sizes)
            found += proposals(scorer, seen, settings)
        chosen = self._promising(found, incumbent)
        models = scorer.simulate([p.hypothesis for p in chosen], incumbent)
        try:
            models = self._fitted(view, models, incumbent, settings.finalists)
            best = min(
                [incumbent, *models],
                key=lambda m: float(np.log(np.maximum(m.mean_square, 1e-30)).sum()),
            )
            before = np.nan_to_num(incumbent.mean_square, posinf=0.0)
            left = scorer.exceeds_floor(best, 2.0 * VERDICT.identifiable)
            if (left & (best.mean_square > settings.scan_above * before)).any():
                trial = TrialSimulation(view.around, view.around.left)
                more = simulated_proposals(scorer, incumbent, best, trial, self.candidates)
                models += self._fitted(view, scorer.simulate(more, best), incumbent, 3)
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

    def _promising(self, found: Sequence[Proposal], incumbent: Model) -> list[Proposal]:
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

    def _fitted(
        self, view: LinearizedView, models: Sequence[Model], incumbent: Model, count: int
    ) -> list[Model]:
        """Models in the order of their gain; the first ``count`` are fitted."""
        scorer = self.scorer
        order = sorted(models, key=lambda m: -scorer.gain(m, incumbent))
        return [
            *corrected_fits(scorer, view, order[:count], self.settings.corrections),
            *order[count:],
        ]

    def _winner(self, incumbent: Model, models: Sequence[Model]) -> Model:
        """The model that passes the acceptance test against all others; smaller ones come first.

        Refused models are left out: those with impossible totals (negative friction or mass), and
        those with shape parameters outside the range of the recordings. Such a model compensates
        for another effect.
        """
        scorer = self.scorer
        order = sorted(
            (m for m in models if not refused(self.problem, m.hypothesis, self.recorded)),
            key=lambda m: (len(m.hypothesis.terms), m.hypothesis.free, -scorer.gain(m, incumbent)),
        )
        best = incumbent
        for model in order:
            if scorer.is_better(model, best):
                best = model
        return best

    def _record(self, model: Model, gain: float, incumbent: Model, *, taken: bool) -> None:
        own, terms = set(incumbent.hypothesis.terms), set(model.hypothesis.terms)
        move = "addition" if own <= terms else "removal" if terms < own else "exchange"
        decision: Decision = "accepted" if taken else "rejected"
        reason = (
            "passes the acceptance test, and no simpler proposal does as well"
            if taken
            else self._reason_of_rejection(model, gain, incumbent)
        )
        # A nominal model that diverges has no finite score.
        score = float(np.nan_to_num(self.scorer.gain(incumbent, self.scorer.nominal), posinf=0.0))
        self.diagnosis_run.step(
            self.problem,
            move,
            decision,
            reason,
            Scored(model.hypothesis, score + gain),
            Scored(incumbent.hypothesis, score),
        )

    def _reason_of_rejection(self, model: Model, gain: float, incumbent: Model) -> str:
        if not np.isfinite(gain):
            return "its simulation diverges"
        if refused(self.problem, model.hypothesis, self.recorded):
            return "it needs an impossible total, or parameters outside the range of the recordings"
        if self.scorer.is_better(model, incumbent):
            return "another proposal is simpler or gains more"
        if model.hypothesis.free <= incumbent.hypothesis.free:
            return f"it scores {gain:+.1f} against the best"
        if gain < self.settings.earns:
            return f"it gains {gain:.1f}; at least {self.settings.earns:g} are needed"
        return "its gain is too small a part of what all effects explain"
