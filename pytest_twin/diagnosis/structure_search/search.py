"""The search: propose, race, accept, until no proposal passes the acceptance test."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.deadline import OutOfTime
from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.first_order.sensitivities import grid
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.recorded_range import RecordedRange
from pytest_twin.diagnosis.refusal import refused
from pytest_twin.diagnosis.run import Run, Scored
from pytest_twin.diagnosis.search.linearized_view import LinearizedView, linearize_around
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.structure_search.proposals import Proposal, proposals
from pytest_twin.diagnosis.structure_search.refit import as_fitted, corrected_fits, settled
from pytest_twin.diagnosis.structure_search.score import Model, Scorer
from pytest_twin.diagnosis.structure_search.settings import SETTINGS, StructureSearchSettings
from pytest_twin.diagnosis.trace import Decision
from pytest_twin.diagnosis.verdict_settings import VERDICT

_SCANNED = 4
"""Models of a scan that are simulated on all recordings."""


@dataclass(slots=True)
class Result:
    """What a search chose.

    Attributes:
        model: accepted.
        jacobian: (samples, signals, parameters) of its fit.
        rivals: models that were simulated beside it and refused, with their log-likelihood ratio
            over it.
        has_left: whether the search was asked to end there.
        is_complete: whether it ended because no proposal passes the acceptance test.
    """

    model: Model
    jacobian: FloatArray
    rivals: list[tuple[Model, float]] = field(default_factory=list)
    has_left: bool = False
    is_complete: bool = False


class StructureSearch:
    """One search over models of a problem.

    Args:
        problem: what to explain.
        run: the diagnosis that the search belongs to.
        settings: thresholds and bounds.
        leave: asked of each accepted model; whether the search ends there.
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
        """Search from a start until no proposal is accepted; the best so far where time ends."""
        nominal = self.scorer.nominal
        result = Result(nominal, np.zeros((*nominal.residual.shape, 0)))
        try:
            if start.terms:
                model, jacobian = settled(
                    self.scorer, self.scorer.at(start), self.settings.refinements
                )
                result = Result(model, jacobian)
            for _ in range(self.settings.rounds):
                following = self._following(result)
                if following is None:
                    return replace(result, is_complete=True)
                result = following
                if self.leave(result.model):
                    return replace(result, has_left=True)
        except OutOfTime:
            with self.diagnosis_run.budget.reserved():
                self.problem.refine_at(result.model.hypothesis)
        return result

    def _following(self, result: Result) -> Result | None:
        """The result with a better model; None where no proposal passes the acceptance test."""
        scorer, incumbent = self.scorer, result.model
        named = bool(incumbent.hypothesis.terms)
        if not named and not scorer.stands_out(incumbent, VERDICT.stands_out).any():
            return None
        fitted = as_fitted(self.problem, incumbent, result.jacobian)
        look = linearize_around(self.problem, ScoredModel(fitted, incumbent.validation))
        models = self._raced(look, incumbent)
        result.rivals = [(m, scorer.gain(m, incumbent)) for m in models]
        winner = self._winner(incumbent, models)
        for model, gain in sorted(result.rivals, key=lambda each: -each[1]):
            self._record(model, gain, incumbent, taken=model is winner)
        if winner is incumbent:
            return None
        try:
            better, jacobian = settled(scorer, winner, self.settings.refinements)
            # Each with the error of the simulator's step as it is at its own parameters.
            own = scorer.at(incumbent.hypothesis)
        except OutOfTime:
            # It was chosen by simulation, and its last fit is what the time is too short for.
            return Result(winner, np.zeros((*winner.residual.shape, 0)))
        scorer.problem.refine_at(better.hypothesis)
        if not scorer.is_better(better, own):
            self._record(better, scorer.gain(better, own), own, taken=False)
            scorer.problem.refine_at(incumbent.hypothesis)
            return None
        return Result(better, jacobian)

    def _raced(self, look: LinearizedView, incumbent: Model) -> list[Model]:
        """Proposals simulated; the best of them fitted."""
        scorer, settings = self.scorer, self.settings
        found = proposals(scorer, look, settings)
        chosen = self._promising(found, incumbent)
        models = scorer.simulate([p.hypothesis for p in chosen])
        models = self._fitted(look, models, incumbent, settings.finalists)
        best = min(
            [incumbent, *models],
            key=lambda m: float(np.log(np.maximum(m.mean_square, 1e-30)).sum()),
        )
        if scorer.stands_out(best, 2.0 * VERDICT.stands_out).any():
            scanned = self._scanned(incumbent, best)
            models += self._fitted(look, scanned, incumbent, 3)
        return models

    def _promising(self, found: Sequence[Proposal], incumbent: Model) -> list[Proposal]:
        """The proposals that are worth a simulation: the best of each size."""
        settings = self.settings
        size = len(incumbent.hypothesis.terms)

        def rank(p: Proposal) -> float:
            # A smaller model wins unless it loses what a name earns.
            return p.gain + settings.earns * max(size - len(p.hypothesis.terms), 0)

        ranked = sorted(found, key=rank, reverse=True)
        # The linearization favours large models: they can fit its errors. Of each number of effects
        # the best are simulated, so that a single right effect is not crowded out.
        chosen, rest, taken = list[Proposal](), list[Proposal](), Counter[int]()
        for proposal in ranked:
            count = len(proposal.hypothesis.terms)
            (chosen if taken[count] < settings.of_each_count else rest).append(proposal)
            taken[count] += 1
        return chosen + rest[: max(settings.proposals - len(chosen), 0)]

    def _fitted(
        self, look: LinearizedView, models: Sequence[Model], incumbent: Model, count: int
    ) -> list[Model]:
        """Models by their gain, the first fitted."""
        scorer = self.scorer
        order = sorted(models, key=lambda m: -scorer.gain(m, incumbent))
        return [
            *corrected_fits(scorer, look, order[:count], self.settings.corrections),
            *order[count:],
        ]

    def _scanned(self, incumbent: Model, best: Model) -> list[Model]:
        """Effects that are not of first order, each at the best size of its grid.

        Transmissions read the motion back, and limits change the motion in leaps: the linearized
        motion says little of either. They are simulated beside all effects and instead of
        those of their joint, on the recording that shows most of the residual.
        """
        scorer, own = self.scorer, incumbent.hypothesis
        joints = len(self.problem.joints)
        out = scorer.stands_out(best, 2.0 * VERDICT.stands_out)[:joints]
        rows: dict[tuple[Term, int], list[Hypothesis]] = {}
        for term in self.candidates:
            if term in own.terms or not _is_scanned(term) or term.joint < 0 or not out[term.joint]:
                continue
            bases = [own]
            mine = [t for t in own.terms if t.joint == term.joint]
            if mine:
                bases.append(own.without(*mine))
            for k, base in enumerate(bases):
                rows[term, k] = [base.with_term(term, size) for size, _ in grid(term)]
        if not rows:
            return []
        every = [h for each in rows.values() for h in each]
        misfit = iter(scorer.misfits_where(every, best))
        found = [min(zip((next(misfit) for _ in each), each, strict=True), key=lambda x: x[0])
                 for each in rows.values()]  # fmt: skip
        found.sort(key=lambda x: x[0])
        return scorer.simulate([h for m, h in found[:_SCANNED] if np.isfinite(m)])

    def _winner(self, incumbent: Model, models: Sequence[Model]) -> Model:
        """The model that the acceptance test leaves: smaller ones first.

        A model with an impossible total, or with a shape outside the range of the recordings,
        compensates for another effect and is none.
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
        size, other = len(model.hypothesis.terms), len(incumbent.hypothesis.terms)
        move = "addition" if size > other else "removal" if size < other else "exchange"
        reason = (
            "passes the acceptance test, and no simpler proposal does as well"
            if taken
            else "does not pass the acceptance test, or a simpler proposal does as well"
        )
        decision: Decision = "accepted" if taken else "rejected"
        self.diagnosis_run.step(
            self.problem,
            move,
            decision,
            reason,
            Scored(model.hypothesis, gain),
            Scored(incumbent.hypothesis, 0.0),
        )


def _is_scanned(term: Term) -> bool:
    return term.law.is_limit or term.law.overrides("separates")
