"""The score of a model, and the one test that decides between two.

Log-likelihood of the fit recordings and of the validation recordings, each signal with its variance
profiled out and counted by its independent samples, minus half a log of these for every parameter
(Schwarz 1978) and the log of the number of candidates for every name (extended BIC: Chen, Chen,
Biometrika 95, 2008).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.evidence import effective_samples, log_likelihood
from pytest_twin.diagnosis.first_order.beam_search import effect_penalty, parameter_penalty
from pytest_twin.diagnosis.hypothesis import Hypothesis
from pytest_twin.diagnosis.problem import Problem


@dataclass(frozen=True, slots=True)
class Model:
    """A hypothesis and its simulated residuals.

    Attributes:
        hypothesis: terms and parameters.
        residual: (samples, signals) on the fit recordings.
        validation: (samples, signals) on the validation recordings; no rows without any.
    """

    hypothesis: Hypothesis
    residual: FloatArray
    validation: FloatArray

    @property
    def mean_square(self) -> FloatArray:
        """(signals,) of the residual on fit and validation recordings, the greater."""
        found: FloatArray = np.mean(self.residual**2, axis=0)
        if len(self.validation):
            found = np.maximum(found, np.mean(self.validation**2, axis=0))
        return np.nan_to_num(found, nan=np.inf)


class Scorer:
    """Compares models of one problem.

    Attributes:
        problem: recordings and simulator.
        name_price: log-likelihood that one more effect has to earn.
        earns, share: as :class:`StructureSearchSettings` has them.
        nominal: the model without any effect.
    """

    def __init__(self, problem: Problem, candidates: int, earns: float, share: float) -> None:
        self.problem = problem
        self.name_price = effect_penalty(candidates)
        self.earns, self.share = earns, share
        self.nominal = self.simulate([Hypothesis((), np.empty(0))])[0]

    def simulate(self, hypotheses: Sequence[Hypothesis]) -> list[Model]:
        """Hypotheses as they are, simulated on all recordings."""
        problem = self.problem
        everywhere = problem.everywhere
        residuals = problem.residuals(hypotheses, everywhere)
        lengths = np.array(problem.lengths(everywhere))
        fitted = np.repeat(np.isin(everywhere, problem.fit), lengths)
        return [Model(h, r[fitted], r[~fitted]) for h, r in zip(hypotheses, residuals, strict=True)]

    def misfits_where(self, hypotheses: Sequence[Hypothesis], model: Model) -> list[float]:
        """Log mean squares, summed, of hypotheses on the fit recording that a model fits worst."""
        problem, floor = self.problem, self.problem.signal_floor
        lengths = problem.lengths(problem.fit)
        parts = np.split(model.residual, np.cumsum(lengths)[:-1])
        worst = int(np.argmax([np.nan_to_num(np.sum((p / floor) ** 2)) for p in parts]))
        found = problem.residuals(hypotheses, problem.fit[worst : worst + 1])
        out = [np.log(np.maximum(np.mean(r**2, axis=0), floor**2)).sum() for r in found]
        return [float(x) if np.isfinite(x) else np.inf for x in out]

    def gain(self, model: Model, over: Model) -> float:
        """Log-likelihood ratio of a model over another, after the prices of its size.

        Both are counted by the independent samples of the better one: an unexplained pulse makes
        all samples depend on each other, whatever else it hides.
        """
        problem, floor = self.problem, self.problem.signal_floor

        def misfit(m: Model) -> float:
            return float(np.log(np.maximum(m.mean_square, floor**2)).sum())

        if not np.isfinite(model.mean_square).all():
            return -np.inf
        if not np.isfinite(over.mean_square).all():
            return np.inf
        better = min(model, over, key=misfit)
        count = effective_samples(better.residual, problem.lengths(problem.fit))
        ratio = log_likelihood(model.residual, floor, count)
        ratio -= log_likelihood(over.residual, floor, count)
        ratio -= parameter_penalty(count) * (model.hypothesis.free - over.hypothesis.free)
        ratio -= self.name_price * (len(model.hypothesis.terms) - len(over.hypothesis.terms))
        if len(better.validation):
            held = effective_samples(better.validation, problem.lengths(problem.held_out))
            ratio += log_likelihood(model.validation, floor, held)
            ratio -= log_likelihood(over.validation, floor, held)
        return ratio

    def is_better(self, model: Model, than: Model) -> bool:
        """Whether a model replaces another: the acceptance test.

        More parameters or more names must earn them by the log-likelihood ratio. More names must
        also earn a share of what the larger model gains over the nominal one: an effect that is
        not quite the real one leaves a residual, and another name follows it a little. The simpler
        of two models stays unless the other earns its size, whichever of them came first.
        """
        size = _size(model)
        other = _size(than)
        if size == other:
            return self.gain(model, than) > 1.0
        if size < other:
            return np.isfinite(self.gain(model, than)) and not self._earns(than, model)
        return self._earns(model, than)

    def _earns(self, larger: Model, smaller: Model) -> bool:
        gain = self.gain(larger, smaller)
        if len(larger.hypothesis.terms) == len(smaller.hypothesis.terms):
            return gain >= self.earns
        return gain >= max(self.earns, self.share * self.gain(larger, self.nominal))

    def stands_out(self, model: Model, floors: float) -> np.ndarray:
        """(signals,) whether the residual is above so many noise floors."""
        return np.asarray(model.mean_square > (floors * self.problem.signal_floor) ** 2)

    def at(self, hypothesis: Hypothesis) -> Model:
        """A hypothesis simulated with the error of the simulator's step measured for itself."""
        self.problem.refine_at(hypothesis)
        return self.simulate([hypothesis])[0]


def _size(model: Model) -> tuple[int, int]:
    return len(model.hypothesis.terms), model.hypothesis.free
