"""The score of a model, and the acceptance test between two models.

The score is the log-likelihood of the fit recordings and of the validation recordings. Each signal
has its variance profiled out and counts by its effective samples n. Every parameter costs
0.5 log(n) (Schwarz 1978). Every effect costs the log of the number of candidates (extended BIC:
Chen, Chen, Biometrika 95, 2008).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import effect_penalty, parameter_penalty
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis
from pytest_twin.estimation.score import effective_samples


@dataclass(frozen=True, slots=True)
class SimulatedModel:
    """A hypothesis and its simulated residuals.

    Attributes:
        residual: (samples, signals) on the fit recordings.
        validation: (samples, signals) on the validation recordings; no rows if there are none.
        problem: the problem with the corrections of these residuals.
    """

    hypothesis: Hypothesis
    residual: FloatArray
    validation: FloatArray
    problem: Problem

    @property
    def mean_square(self) -> FloatArray:
        """(signals,) mean squared residual, the larger of fit and validation recordings."""
        found: FloatArray = np.mean(self.residual**2, axis=0)
        if len(self.validation):
            found = np.maximum(found, np.mean(self.validation**2, axis=0))
        return np.nan_to_num(found, nan=np.inf)


class Scorer:
    """Scores and compares models of one problem.

    Attributes:
        penalty_per_effect: penalty of the log-likelihood for each effect.
        earns, share: thresholds, as in :class:`StructureSearchSettings`.
        nominal: the model without any effect.
    """

    def __init__(self, problem: Problem, candidates: int, earns: float, share: float) -> None:
        self.problem = problem
        self.penalty_per_effect = effect_penalty(candidates)
        self.earns, self.share = earns, share
        self.nominal = self.simulate_with_own_correction(EMPTY)

    def simulate(
        self, hypotheses: Sequence[Hypothesis], corrected_as: SimulatedModel
    ) -> list[SimulatedModel]:
        """Simulate hypotheses on all recordings, without fitting them.

        Args:
            corrected_as: the model whose corrections their predictions have.
        """
        return self._simulate(corrected_as.problem, hypotheses)

    @staticmethod
    def _simulate(problem: Problem, hypotheses: Sequence[Hypothesis]) -> list[SimulatedModel]:
        everywhere = problem.all_segments
        residuals = problem.residuals(hypotheses, everywhere)
        lengths = np.array(problem.lengths(everywhere))
        fitted = np.repeat(np.isin(everywhere, problem.fit), lengths)
        return [
            SimulatedModel(h, r[fitted], r[~fitted], problem)
            for h, r in zip(hypotheses, residuals, strict=True)
        ]

    def misfits_on_worst_recording(
        self, hypotheses: Sequence[Hypothesis], model: SimulatedModel
    ) -> list[float]:
        """Misfit of each hypothesis on the fit recording that ``model`` fits worst.

        The misfit is the sum over signals of log(mean squared residual), where no mean square is
        below the squared noise floor; infinite if the simulation diverges.
        """
        problem, floor = model.problem, self.problem.signal_floor
        lengths = problem.lengths(problem.fit)
        parts = np.split(model.residual, np.cumsum(lengths)[:-1])
        worst = int(np.argmax([np.nan_to_num(np.sum((p / floor) ** 2)) for p in parts]))
        found = problem.residuals(hypotheses, problem.fit[worst : worst + 1])
        out = [np.log(np.maximum(np.mean(r**2, axis=0), floor**2)).sum() for r in found]
        return [float(x) if np.isfinite(x) else np.inf for x in out]

    def gain(self, model: SimulatedModel, over: SimulatedModel) -> float:
        """Log-likelihood ratio of ``model`` to ``over``, minus the penalties of its size.

        Both use the effective samples of the better model, because an unexplained disturbance
        correlates all samples of the worse one.

        Returns:
            Minus infinity if ``model`` diverges, infinity if only ``over`` diverges.
        """
        if not np.isfinite(model.mean_square).all():
            return -np.inf
        if not np.isfinite(over.mean_square).all():
            return np.inf
        better = min(model, over, key=self._misfit)
        count = effective_samples(better.residual, self.problem.lengths(self.problem.fit))
        ratio = float(self.gain_by_signal(model, over).sum())
        ratio -= parameter_penalty(count) * (
            model.hypothesis.free_count - over.hypothesis.free_count
        )
        return ratio - self.penalty_per_effect * (
            len(model.hypothesis.terms) - len(over.hypothesis.terms)
        )

    def is_better(self, model: SimulatedModel, than: SimulatedModel) -> bool:
        """Whether ``model`` replaces ``than``: the acceptance test.

        A model with more effects or parameters needs a penalized log-likelihood ratio of at least
        ``earns``. With more effects, it also needs ``share`` of its ratio to the nominal model, in
        all or in one signal: after an inexact effect a residual remains, which a wrong effect can
        reduce a little. That residual is in the signals that the inexact effect changes, so a small
        effect at another joint, or beside a large error of effort readings, is not held against it.
        Otherwise the simpler model is kept, whichever was proposed first.
        """
        size = _size(model)
        other = _size(than)
        if size == other:
            return self.gain(model, than) > 1.0
        if size < other:
            return np.isfinite(self.gain(model, than)) and not self._gains_enough(than, model)
        return self._gains_enough(model, than)

    def _gains_enough(self, larger: SimulatedModel, smaller: SimulatedModel) -> bool:
        if self.gain(larger, smaller) < self.earns:
            return False
        if len(larger.hypothesis.terms) == len(smaller.hypothesis.terms):
            return True
        added, whole = (self.gain_by_signal(larger, m) for m in (smaller, self.nominal))
        # A nominal model that diverges is no measure of what the rest explains.
        whole = np.where(np.isfinite(whole), whole, 0.0)
        worth = np.maximum(self.share * whole, self.earns)
        return bool((added >= worth).any() or added.sum() >= self.share * whole.sum())

    def gain_by_signal(self, model: SimulatedModel, over: SimulatedModel) -> FloatArray:
        """(signals,) log-likelihood ratio of ``model`` to ``over``, without penalties.

        Infinite if only ``over`` diverges.
        """
        floor, problem = self.problem.signal_floor, self.problem
        better = min(model, over, key=self._misfit)
        out = np.zeros(len(floor))
        for best, one, other, segments in (
            (better.residual, model.residual, over.residual, problem.fit),
            (better.validation, model.validation, over.validation, problem.held_out),
        ):
            if len(best):
                count = effective_samples(best, problem.lengths(segments))
                squares = (np.mean(r**2, axis=0) for r in (other, one))
                known = (np.maximum(np.nan_to_num(s, nan=np.inf), floor**2) for s in squares)
                out += 0.5 * count * np.subtract(*map(np.log, known))
        return np.nan_to_num(out, nan=-np.inf, posinf=np.inf, neginf=-np.inf)

    def _misfit(self, model: SimulatedModel) -> float:
        """Sum over signals of the logarithm of the mean square, which is at least that of noise."""
        return float(np.log(np.maximum(model.mean_square, self.problem.signal_floor**2)).sum())

    def exceeds_floor(self, model: SimulatedModel, floors: float) -> np.ndarray:
        """(signals,) whether the RMS residual exceeds ``floors`` noise floors."""
        return np.asarray(model.mean_square > (floors * self.problem.signal_floor) ** 2)

    def simulate_with_own_correction(self, hypothesis: Hypothesis) -> SimulatedModel:
        """Simulate a hypothesis with the discretization error measured at its parameters."""
        return self._simulate(self.problem.at(hypothesis), [hypothesis])[0]


def _size(model: SimulatedModel) -> tuple[int, int]:
    return len(model.hypothesis.terms), model.hypothesis.free_count
