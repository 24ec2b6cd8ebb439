"""Comparison of models that are fitted by simulation.

The evidence of a model is its log-likelihood on the fit recordings, minus half the logarithm of the
effective sample size for each parameter (BIC: Schwarz 1978) and a penalty for each effect, plus its
log-likelihood on the validation recordings.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import (
    candidates,
    effect_penalty,
    parameter_penalty,
)
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run, ScoredHypothesis
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search.settings import COMPARISON
from pytest_twin.diagnosis.trace import Decision
from pytest_twin.diagnosis.verdict import own_mismatch, reduces_error_enough
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.estimation.least_squares import fit
from pytest_twin.estimation.score import Likelihood, effective_samples, log_likelihood

RANKING_ITERATIONS, DECIDING_ITERATIONS, FULL_ITERATIONS = 2, 4, 8
"""Iterations of a fit that ranks models, of one that decides between them, and of a full fit."""


class ModelComparison:
    """Fits and scores the models of one search.

    Attributes:
        has_validation: whether there are validation recordings, which no fit uses.
        candidate_count: number of candidates, each an effect at a joint.
        penalty_per_effect: penalty of the log-likelihood for each effect, chosen from
            ``candidate_count``.
        since: number of steps that were simulated before this search.
    """

    def __init__(self, problem: Problem, run: Run | None = None) -> None:
        self.problem = problem
        self.run = Run() if run is None else run
        self.since = problem.simulated_steps
        self.has_validation = bool(len(problem.held_out))
        self.candidate_count = len(candidates(problem))
        self.penalty_per_effect = effect_penalty(self.candidate_count)
        with self.run.budget.reserved():
            self.nominal = self.score_without_fit(EMPTY)
        self._scored = self.nominal, 0.0

    @property
    def sample_ratio(self) -> float:
        """Number of samples of all recordings divided by that of the fit recordings."""
        problem = self.problem
        everything, fitted = (sum(problem.lengths(x)) for x in (problem.all_segments, problem.fit))
        return everything / fitted

    def weights(self, model: ScoredModel) -> FloatArray:
        """(signals,) reciprocal standard deviations, from the residual of a model."""
        return self.problem.weights(model.fitted.mean_square)

    def fit_models(
        self,
        starts: Sequence[Hypothesis],
        best: ScoredModel,
        iterations: int,
        *,
        weights: FloatArray | None = None,
        slopes: bool = False,
    ) -> list[ScoredModel]:
        """Hypotheses fitted by a number of iterations, with their residuals on all recordings.

        Args:
            starts: the hypotheses with the parameters at which the fits start.
            best: the model whose corrections their predictions have.
            iterations: of the fit; 0 only simulates.
            weights: (signals,) reciprocal standard deviations; from the residual of ``best`` by
                default.
            slopes: whether the Jacobian at the result is computed.
        """
        weights = self.weights(best) if weights is None else weights
        return self._fit(best.problem, starts, weights, iterations, slopes=slopes)

    def _fit(
        self,
        problem: Problem,
        starts: Sequence[Hypothesis],
        weights: FloatArray,
        iterations: int,
        *,
        slopes: bool = False,
    ) -> list[ScoredModel]:
        fitted = fit(problem, starts, weights, problem.fit, iterations=iterations, slopes=slopes)
        if self.has_validation:
            held = problem.residuals([f.hypothesis for f in fitted], problem.held_out)
        else:
            held = [np.zeros((0, len(problem.signal_floor)))] * len(fitted)
        return [ScoredModel(f, h, problem) for f, h in zip(fitted, held, strict=True)]

    def score_without_fit(self, hypothesis: Hypothesis, *, slopes: bool = False) -> ScoredModel:
        """A fitted hypothesis, simulated with the discretization error at its own parameters."""
        problem = self.problem.at(hypothesis)
        weights = np.ones(len(problem.signal_floor))
        return self._fit(problem, [hypothesis], weights, 0, slopes=slopes)[0]

    def score_models(
        self,
        models: Sequence[ScoredModel],
        reference: ScoredModel,
        noise_model: ScoredModel | None = None,
        likelihood: Likelihood = log_likelihood,
    ) -> None:
        """Set the evidence of ``models`` relative to ``reference``.

        Args:
            models: fitted models; their ``evidence`` and ``held_gain`` are set.
            reference: the model with evidence 0.
            noise_model: the model whose residual gives the effective sample size; ``reference`` by
                default.
            likelihood: log-likelihood of a residual.
        """
        problem, floor = self.problem, self.problem.signal_floor
        noise_model = reference if noise_model is None else noise_model
        fit_n = effective_samples(noise_model.fitted.residual, problem.lengths(problem.fit))
        base = likelihood(reference.fitted.residual, floor, fit_n)
        cost = parameter_penalty(fit_n)
        if self.has_validation:
            held_n = effective_samples(noise_model.held_residual, problem.lengths(problem.held_out))
            held_base = likelihood(reference.held_residual, floor, held_n)
        for r in models:
            more = r.hypothesis.free_count - reference.hypothesis.free_count
            names = len(r.hypothesis.terms) - len(reference.hypothesis.terms)
            r.evidence = likelihood(r.fitted.residual, floor, fit_n) - base
            r.evidence -= cost * more + self.penalty_per_effect * names
            if self.has_validation:
                r.held_gain = likelihood(r.held_residual, floor, held_n) - held_base
                r.evidence += r.held_gain

    def score_against(
        self, starts: Sequence[Hypothesis], best: ScoredModel, iterations: int, first: int = 1
    ) -> list[ScoredModel]:
        """Fit ``starts`` and score them against ``best``, in the order of ``starts``.

        A fit ends after the ``first`` iterations if the model is then far behind.
        """
        models = self.fit_models(starts, best, first)
        self.score_models(models, best)
        to_continue = [i for i, r in enumerate(models) if r.evidence > -COMPARISON.hopeless]
        again = self.fit_models(
            [models[i].hypothesis for i in to_continue], best, iterations - first
        )
        self.score_models(again, best)
        for i, r in zip(to_continue, again, strict=True):
            models[i] = r
        return models

    def validation_mean_square(self, model: ScoredModel) -> FloatArray:
        """(signals,) mean squared error on validation recordings; without any, on the others."""
        if not self.has_validation:
            return model.fitted.mean_square
        mean_square: FloatArray = np.mean(model.held_residual**2, axis=0)
        return mean_square

    def has_residual_to_explain(self, model: ScoredModel) -> bool:
        """Whether an effect that removes the whole residual would reduce the error enough."""
        floor = self.problem.signal_floor**2
        left = model.max_mean_square
        least = np.where(left > VERDICT.identifiable**2 * floor, floor, left)
        return self.reduces_error_enough(
            left, least, self.mismatch(model, self.nominal.max_mean_square, left)
        )

    def reduces_error_enough(
        self, before: FloatArray, after: FloatArray, whole: FloatArray
    ) -> bool:
        """Whether an error is reduced enough for one more effect.

        Args:
            before, after: (signals,) mean squared errors without and with the effect.
            whole: (signals,) mean squared error of the nominal model.
        """
        floor = self.problem.signal_floor
        return reduces_error_enough(floor, before, after, whole, VERDICT.identifiable)

    def mismatch(self, model: ScoredModel, whole: FloatArray, left: FloatArray) -> FloatArray:
        """(signals,) mean squared error of the nominal model that other effects have to explain.

        The part that the laws of ``model`` may leave because they are inexact is not counted.

        Args:
            whole: (signals,) mean squared error of the nominal model.
            left: (signals,) mean squared error of ``model``.
        """
        acting = self.problem.is_acted_on_by(model.hypothesis.terms)
        return own_mismatch(self.problem.signal_floor, whole, left, acting)

    def fit_with_own_correction(self, start: Hypothesis, best: ScoredModel) -> ScoredModel:
        """A hypothesis, fitted with the discretization error at its own parameters."""
        return self._fit(self.problem.at(start), [start], self.weights(best), DECIDING_ITERATIONS)[
            0
        ]

    def fit_to_convergence(self, model: ScoredModel) -> ScoredModel:
        """A model fitted until convergence, with the discretization error at its parameters.

        If time runs out, the model as it was before.
        """
        try:
            return self._fit_to_convergence(model)
        except OutOfTime:
            return model

    def _fit_to_convergence(self, model: ScoredModel) -> ScoredModel:
        start, weights = model.hypothesis, self.weights(model)
        problem = self.problem.at(start)
        (converged,) = self._fit(problem, [start], weights, FULL_ITERATIONS, slopes=True)
        if not np.isfinite(converged.held_residual).all():
            # A fit that diverges on held-out recordings is none: stay where it did not.
            (converged,) = self._fit(problem, [start], weights, 0, slopes=True)
        return converged

    def is_spent(self, found: Sequence[Term]) -> bool:
        """Whether this search, or all searches together, have used their simulations.

        Args:
            found: effects that the search has found; each allows more simulations.
        """
        once = self.problem.steps_per_simulation
        names = sum(
            min(n, COMPARISON.effects_counted) for n in Counter(t.joint for t in found).values()
        )
        most = COMPARISON.simulations + COMPARISON.simulations_per_effect * names
        return self.run.budget.is_spent or self.problem.simulated_steps - self.since > most * once

    def record_step(
        self,
        move: str,
        decision: Decision,
        reason: str,
        proposed: ScoredModel | None,
        best: ScoredModel,
    ) -> None:
        """Record a step; the evidence of ``proposed`` is relative to ``best``."""
        score = self._score(best)
        self.run.step(
            self.problem, move, decision, reason,
            ScoredHypothesis()
            if proposed is None
            else ScoredHypothesis(proposed.hypothesis, score + proposed.evidence),
            ScoredHypothesis(best.hypothesis, score),
        )  # fmt: skip

    def _score(self, model: ScoredModel) -> float:
        """Evidence of a model relative to the nominal model."""
        known, score = self._scored
        if known is not model:
            copy = replace(model)
            self.score_models([copy], self.nominal)
            score = copy.evidence
            self._scored = model, score
        return score
