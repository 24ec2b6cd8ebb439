"""A simulated model, and the pool of all models that a search has simulated."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.estimation.comparison import Comparison, Size
from pytest_twin.estimation.hypothesis import Hypothesis
from pytest_twin.estimation.score import NOISE_FLOORS

LEAST_ODDS = 0.01
"""Odds against the incumbent from which a set widens the intervals of parameters."""
_MOST_RESIDUALS = 64
"""Residuals that a pool keeps, those of the models with the most evidence."""


@dataclass(frozen=True, slots=True)
class Model:
    """A hypothesis and its simulated residual.

    Attributes:
        residual: (samples, signals) measured minus predicted.
        size: number of effects and parameters.
        origin: how it was proposed, for the trace.
        corrected_at: hypothesis at which the corrections of its prediction were measured.
        jacobian: (samples, signals, parameters) derivative of the prediction; None if unknown.
        held_out: (samples, signals) residual of each recording with the parameters of the others;
            None without a Jacobian.
        score: absolute score, cross-validated where the Jacobian is known.
        is_fitted: whether it was fitted by simulation.
    """

    hypothesis: Hypothesis
    residual: FloatArray
    size: Size
    origin: str
    corrected_at: Hypothesis
    score: float
    jacobian: FloatArray | None = None
    held_out: FloatArray | None = None
    is_fitted: bool = False

    @property
    def mean_square(self) -> FloatArray:
        """(signals,) mean squared residual; infinite where the simulation diverged."""
        with np.errstate(over="ignore", invalid="ignore"):
            mean: FloatArray = np.mean(self.residual**2, axis=0)
        return np.where(np.isfinite(mean), mean, np.inf)

    @property
    def predicted(self) -> FloatArray:
        """The cross-validated residual, or that of the fit where no Jacobian is known."""
        return self.residual if self.held_out is None else self.held_out

    @property
    def is_finite(self) -> bool:
        """Whether its simulation stays finite."""
        return bool(np.isfinite(self.mean_square).all())

    @classmethod
    def of(
        cls,
        comparison: Comparison,
        hypothesis: Hypothesis,
        residual: FloatArray,
        size: Size,
        origin: str,
        corrected_at: Hypothesis,
    ) -> Model:
        """A model that is simulated, with the score of its fit."""
        model = cls(hypothesis, residual, size, origin, corrected_at, -np.inf)
        return replace(model, score=_score(comparison, model))

    def with_jacobian(self, comparison: Comparison, jacobian: FloatArray) -> Model:
        """The model with its cross-validated residual and score."""
        held_out = comparison.cross_validated(
            self.residual, jacobian, self.hypothesis.theta, self.hypothesis.bounds
        )
        model = replace(self, jacobian=jacobian, held_out=held_out)
        return replace(model, score=_score(comparison, model))


def _score(comparison: Comparison, model: Model) -> float:
    with np.errstate(over="ignore", invalid="ignore"):
        mean_square = np.mean(model.predicted**2, axis=0)
    # A fit without a fold never counts as better than the fit to all.
    mean_square = np.maximum(mean_square, model.mean_square)
    return comparison.log_likelihood(mean_square) - comparison.penalty(model.size)


@dataclass(frozen=True, slots=True)
class Acceptance:
    """Whether a model replaces another one, and why, for the reader."""

    is_accepted: bool
    reason: str


@dataclass(frozen=True, slots=True)
class PooledModel:
    """What the pool keeps of a model.

    Attributes:
        size: number of effects and parameters.
        evidence: penalized log-likelihood in which residuals at the level of noise are equal.
        is_simulated: whether its prediction was simulated, not linearized.
        difference: largest RMS difference of its prediction to that of the incumbent at that time,
            in noise floors; None if unknown.
        score: cross-validated score; None without a Jacobian.
    """

    hypothesis: Hypothesis
    size: Size
    evidence: float
    is_simulated: bool = True
    difference: float | None = None
    score: float | None = None


@dataclass(slots=True)
class Pool:
    """Every model of a search, each set of terms with its best parameters.

    Attributes:
        comparison: by which all models are scored.
        simulations: number of models that were simulated.
    """

    comparison: Comparison
    simulations: int = 0
    _simulated: dict[frozenset[object], PooledModel] = field(default_factory=dict)
    _residuals: dict[frozenset[object], NDArray[np.float32]] = field(default_factory=dict)
    _scores: dict[frozenset[object], float] = field(default_factory=dict)
    _linearized: dict[frozenset[object], PooledModel] = field(default_factory=dict)
    _around: frozenset[object] = frozenset()

    def add(self, model: Model) -> None:
        """Keep a simulated model, if it is the best of its set of terms so far."""
        self.simulations += 1
        if not model.is_finite:
            return
        evidence = evidence_of(self.comparison, model.mean_square, model.size)
        key = frozenset(model.hypothesis.terms)
        known = self._simulated.get(key)
        if model.jacobian is not None:
            self._scores[key] = max(model.score, self._scores.get(key, -np.inf))
        if known is None or evidence > known.evidence:
            self._simulated[key] = PooledModel(model.hypothesis, model.size, evidence)
            self._residuals[key] = model.residual.astype(np.float32)
            if len(self._residuals) > _MOST_RESIDUALS:
                least = min(self._residuals, key=lambda k: self._simulated[k].evidence)
                del self._residuals[least]

    def set_linearized(self, around: Model, rivals: Iterable[PooledModel]) -> None:
        """Keep rivals that were fitted in the motion linearized around a model only.

        They take the place of those of earlier linearizations.

        Args:
            around: the model. The evidence of a rival is relative to it.
        """
        own = evidence_of(self.comparison, around.mean_square, around.size)
        self._around, self._linearized = frozenset(around.hypothesis.terms), {}
        for rival in rivals:
            key, evidence = frozenset(rival.hypothesis.terms), own + rival.evidence
            known = self._linearized.get(key)
            if np.isfinite(evidence) and (known is None or evidence > known.evidence):
                self._linearized[key] = replace(rival, evidence=evidence)

    def best_simpler(self, incumbent: Model) -> Hypothesis | None:
        """The best simulated set with fewer effects, of which the incumbent lacks one."""
        own = set(incumbent.hypothesis.terms)
        simpler = [
            m
            for m in self._simulated.values()
            if 0 < m.size.effects < incumbent.size.effects
            and not own.issuperset(m.hypothesis.terms)
        ]
        return max(simpler, key=lambda m: m.evidence).hypothesis if simpler else None

    def rivals_of(self, incumbent: Model) -> Iterator[PooledModel]:
        """All other sets of the pool; a linearized one only if it was never simulated."""
        own = frozenset(incumbent.hypothesis.terms)
        for key, pooled in self._simulated.items():
            if key != own:
                residual = self._residuals.get(key)
                known = None if residual is None else self._difference(residual, incumbent)
                yield replace(pooled, difference=known, score=self._scores.get(key))
        for key, pooled in self._linearized.items():
            if key != own and key not in self._simulated:
                yield pooled if own == self._around else replace(pooled, difference=None)

    def _difference(self, residual: NDArray[np.float32], incumbent: Model) -> float:
        change = np.sqrt(np.mean((residual - incumbent.residual) ** 2, axis=0))
        return float((change / self.comparison.floor).max())


def evidence_of(comparison: Comparison, mean_square: FloatArray, size: Size) -> float:
    """Penalized log-likelihood in which residuals up to ``NOISE_FLOORS`` count as noise."""
    return comparison.log_likelihood(mean_square, NOISE_FLOORS) - comparison.penalty(size)


def is_rival_of(incumbent: Model, comparison: Comparison, size: Size) -> bool:
    """Whether a model of a size that left noise alone would have odds that matter."""
    own = evidence_of(comparison, incumbent.mean_square, incumbent.size)
    largest = evidence_of(comparison, np.zeros_like(comparison.floor), size)
    return bool(largest - own > np.log(LEAST_ODDS))
