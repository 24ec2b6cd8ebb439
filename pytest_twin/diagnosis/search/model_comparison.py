"""Where rivals meet: fitted side by side by simulation, and judged by evidence.

Log-likelihood on the fit recordings less half a log of the effective samples for each parameter
(Schwarz 1978), plus log-likelihood on the validation recordings.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.deadline import OutOfTime
from pytest_twin.diagnosis.evidence import Likelihood, effective_samples, log_likelihood
from pytest_twin.diagnosis.first_order.beam_search import (
    candidates,
    effect_penalty,
    parameter_penalty,
)
from pytest_twin.diagnosis.fit import fit, weighted_cost
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search.settings import COMPARISON
from pytest_twin.diagnosis.verdict import own_mismatch, worth_a_name
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.effects.segment import Predicted

QUICK, FAIR, LONG = 2, 4, 8
"""Iterations of a fit that ranks, of one that decides, and of one that goes to the end."""


class ModelComparison:
    """All fits of one search.

    Attributes:
        problem: what to explain.
        has_held: whether there are recordings that no fit sees.
        tried: effects at joints that compete.
        name_price: evidence that a name has to earn, drawn from so many.
        nominal: the nominal model.
        since: steps that were simulated before it.
        run: the diagnosis that it belongs to.
    """

    def __init__(self, problem: Problem, run: Run | None = None) -> None:
        self.problem = problem
        self.run = Run() if run is None else run
        self.since = problem.stepped
        self.has_held = bool(len(problem.held_out))
        self.tried = len(candidates(problem))
        self.name_price = effect_penalty(self.tried)
        # An earlier search may have left the step corrected for what it came to.
        with self.run.budget.reserved():
            self.nominal = self.scored_without_fit(EMPTY)

    @property
    def of_all(self) -> float:
        """Samples of all recordings for each of those that are fitted."""
        problem = self.problem
        everything, fitted = (sum(problem.lengths(x)) for x in (problem.everywhere, problem.fit))
        return everything / fitted

    def weights(self, rival: ScoredModel) -> FloatArray:
        """(signals,) reciprocal deviations of what a rival leaves."""
        return self.problem.weights(rival.fitted.mean_square)

    def rivals(
        self,
        starts: Sequence[Hypothesis],
        weights: FloatArray,
        iterations: int,
        *,
        slopes: bool = False,
    ) -> list[ScoredModel]:
        """Hypotheses fitted by so many iterations, and what they leave of what no fit sees."""
        problem = self.problem
        fitted = fit(problem, starts, weights, problem.fit, iterations=iterations, slopes=slopes)
        if self.has_held:
            held = problem.residuals([f.hypothesis for f in fitted], problem.held_out)
        else:
            held = [np.zeros((0, len(problem.signal_floor)))] * len(fitted)
        return [ScoredModel(f, h) for f, h in zip(fitted, held, strict=True)]

    def nearest(self, hypotheses: Sequence[Hypothesis], weights: FloatArray) -> Hypothesis:
        """The one that leaves least of what is fitted, each as it is."""
        if len(hypotheses) == 1:
            return hypotheses[0]
        left = self.problem.residuals(hypotheses, self.problem.fit)
        costs = [weighted_cost(residual, weights) for residual in left]
        return hypotheses[int(np.argmin(costs))]

    def scored_without_fit(self, hypothesis: Hypothesis, *, slopes: bool = False) -> ScoredModel:
        """A hypothesis that is fitted already, with the simulator's step corrected for it."""
        self.problem.refine_at(hypothesis)
        weights = np.ones(len(self.problem.signal_floor))
        return self.rivals([hypothesis], weights, 0, slopes=slopes)[0]

    def judge(
        self,
        rivals: Sequence[ScoredModel],
        against: ScoredModel,
        under: ScoredModel | None = None,
        likelihood: Likelihood = log_likelihood,
    ) -> None:
        """Evidence of ``rivals`` over ``against``, by the effective samples of ``under``."""
        problem, floor = self.problem, self.problem.signal_floor
        under = against if under is None else under
        fit_n = effective_samples(under.fitted.residual, problem.lengths(problem.fit))
        base = likelihood(against.fitted.residual, floor, fit_n)
        cost = parameter_penalty(fit_n)
        if self.has_held:
            held_n = effective_samples(under.held_residual, problem.lengths(problem.held_out))
            held_base = likelihood(against.held_residual, floor, held_n)
        for r in rivals:
            more = r.hypothesis.free - against.hypothesis.free
            names = len(r.hypothesis.terms) - len(against.hypothesis.terms)
            r.evidence = likelihood(r.fitted.residual, floor, fit_n) - base
            r.evidence -= cost * more + self.name_price * names
            if self.has_held:
                r.held_gain = likelihood(r.held_residual, floor, held_n) - held_base
                r.evidence += r.held_gain

    def against(
        self, starts: Sequence[Hypothesis], best: ScoredModel, iterations: int, first: int = 1
    ) -> list[ScoredModel]:
        """Rivals in the order of ``starts`` by evidence over ``best``: all after the ``first``
        iterations, those that are not far behind then after all.
        """
        weights = self.weights(best)
        rivals = self.rivals(starts, weights, first)
        self.judge(rivals, best)
        near = [i for i, r in enumerate(rivals) if r.evidence > -COMPARISON.hopeless]
        again = self.rivals([rivals[i].hypothesis for i in near], weights, iterations - first)
        self.judge(again, best)
        for i, r in zip(near, again, strict=True):
            rivals[i] = r
        return rivals

    def unseen(self, rival: ScoredModel) -> FloatArray:
        """(signals,) mean square on the validation recordings; without any, on the fitted ones."""
        if not self.has_held:
            return rival.fitted.mean_square
        mean_square: FloatArray = np.mean(rival.held_residual**2, axis=0)
        return mean_square

    def worth_a_search(self, rival: ScoredModel) -> bool:
        """Whether any joint has left what would be worth a name if all of it went."""
        floor = self.problem.signal_floor**2
        left = rival.left
        least = np.where(left > VERDICT.stands_out**2 * floor, floor, left)
        return self.worth_a_name(left, least, self.mismatch(rival, self.nominal.left, left))

    def worth_a_name(self, before: FloatArray, after: FloatArray, whole: FloatArray) -> bool:
        """Whether mean squares (signals,) fall by enough; ``whole`` of the nominal model."""
        return worth_a_name(self.problem.signal_floor, before, after, whole)

    def mismatch(self, rival: ScoredModel, whole: FloatArray, left: FloatArray) -> FloatArray:
        """(signals,) of ``whole``, mean squares of the nominal model, what the laws of a rival
        may have left a part of, of which ``left`` is left.
        """
        acting = self.problem.acted_on(rival.hypothesis.terms)
        return own_mismatch(self.problem.signal_floor, whole, left, acting)

    def race(
        self, starts: Sequence[Hypothesis], weights: FloatArray, best: ScoredModel
    ) -> list[ScoredModel]:
        """Rivals by evidence over ``best``: all after one iteration, those in front after more."""
        rivals = self.rivals(starts, weights, 1)
        self.judge(rivals, best, min(rivals, key=lambda r: r.fitted.cost))
        rivals.sort(key=lambda r: -r.evidence)
        front = [r for r in rivals if r.evidence > rivals[0].evidence - COMPARISON.in_race][
            : COMPARISON.finalists
        ]
        again = self.rivals([r.hypothesis for r in front], weights, QUICK)
        rivals[: len(front)] = again
        self.judge(rivals, best, min(rivals, key=lambda r: r.fitted.cost))
        rivals.sort(key=lambda r: -r.evidence)
        contenders = [
            r
            for r in rivals
            if r.evidence > (1.0 - COMPARISON.close_race) * rivals[0].evidence > 0.0
        ]
        contenders = contenders[: COMPARISON.most_close]
        if len(contenders) > 1:
            own = [self._at_its_own(r, weights) for r in contenders]
            rivals[: len(contenders)] = own
            self.judge(own, best, min(own, key=lambda r: r.fitted.cost))
        return sorted(rivals, key=lambda r: -r.evidence)

    def _at_its_own(self, rival: ScoredModel, weights: FloatArray) -> ScoredModel:
        """A rival with the simulator's step corrected for itself, fitted on where that moves it: a
        elastic transmission has a larger integration error than its alternatives.
        """
        before = self.problem.discretization_error
        self.problem.refine_at(rival.hypothesis)
        moved = self._apart(before, self.problem.discretization_error) > COMPARISON.moved
        return self.rivals([rival.hypothesis], weights, QUICK if moved else 0)[0]

    def _apart(self, one: Mapping[int, Predicted], other: Mapping[int, Predicted]) -> float:
        """By how many floors two corrections of what is fitted differ, where they do most."""
        both = [int(i) for i in self.problem.fit if i in one and i in other]
        if not both:
            return 0.0
        difference = np.concatenate([one[i].position - other[i].position for i in both])
        rms = np.sqrt(np.mean(difference**2, axis=0))
        return float(np.max(rms / self.problem.signal_floor[: len(rms)]))

    def settled(self, rival: ScoredModel) -> ScoredModel:
        """The rival fitted to the end, with the simulator's step corrected where it now stands; as
        far as the fit got before time ran out.
        """
        try:
            return self._settled(rival)
        except OutOfTime:
            return rival

    def _settled(self, rival: ScoredModel) -> ScoredModel:
        # Where impacts fall between steps depends on the parameters themselves.
        for _ in range(COMPARISON.rough_rounds if rival.hypothesis.is_rough else 1):
            self.problem.refine_at(rival.hypothesis)
            settled = self.rivals([rival.hypothesis], self.weights(rival), LONG, slopes=True)[0]
            if not np.isfinite(settled.held_residual).all():
                # A fit that diverges on what it has not seen is none: stay where it did not.
                return self.rivals([rival.hypothesis], self.weights(rival), 0, slopes=True)[0]
            rival = settled
        return rival

    def is_spent(self, found: Sequence[Term]) -> bool:
        """Whether as much was simulated as a search that found these may take, or as all searches
        of the diagnosis may.
        """
        once = self.problem.once
        names = sum(
            min(n, COMPARISON.effects_counted) for n in Counter(t.joint for t in found).values()
        )
        most = COMPARISON.simulations + COMPARISON.simulations_per_effect * names
        return self.run.budget.is_spent or self.problem.stepped - self.since > most * once
