"""What all models of one search are compared by: noise, blocks and folds, fixed before the search.

The score of a model is a penalized log-likelihood of residuals that were predicted without the
recording they belong to (cross-validation). Each signal has its variance profiled out, and no
variance is below the noise floor. The number of independent samples is that of the nominal model's
residual: model error does not average out within a motion (Kish, Survey Sampling, 1965). Every
parameter costs 0.5 log(n) (Schwarz 1978), every effect the log of the number of candidates
(extended BIC: Chen, Chen, Biometrika 95, 2008). Scores are therefore absolute: a score never
depends on another model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.estimation.score import NOISE_FLOORS, effective_samples

_PARTS_OF_ONE_RECORDING = 4
"""Folds of a single recording, each a part of its time."""
_FEWEST_BLOCKS, _MOST_BLOCKS = 2, 20
"""Smallest and largest number of blocks of a recording."""
_CORRELATION_TIMES = 2.0
"""Length of a block, in correlation times of the nominal residual."""
_MOST_OF_ONE_FOLD = 100.0
"""Largest ratio of the information of one fold to that of all others, for any combination of
parameters: beyond it the standard error from the others is ten times that of the fold alone, and
they predict nothing of what it shows."""
_RIDGE = 1e-8
"""Share of the diagonal that is added to a normal matrix, so that dependent parameters can be
solved."""


class IncomparableModelsError(ValueError):
    """Two residuals do not belong to the same samples."""


@dataclass(frozen=True, slots=True)
class Size:
    """Number of effects and of estimated parameters of a model.

    Attributes:
        surprise: minus the log-density of its parameters under what was known of them before.
    """

    effects: int
    parameters: int
    surprise: float = field(default=0.0, compare=False)

    def is_richer_than(self, other: Size) -> bool:
        """Whether a model of this size has more effects, or as many with more parameters."""
        return (self.effects, self.parameters) > (other.effects, other.parameters)


@dataclass(frozen=True, slots=True)
class Comparison:
    """Noise, blocks and folds by which all models of a search are compared.

    Attributes:
        floor: (signals,) noise floor, in the unit of each signal.
        independent: (signals,) number of independent samples.
        block: (samples,) index of the block of each sample. Blocks are longer than the correlation
            of the nominal residual and do not cross recordings.
        fold: (samples,) index of the fold of each sample: its recording, or a part of the only one.
        has_one_recording: whether the folds are parts of a single recording.
        part: (samples,) index of a part of the fold, by which the fold is predicted where no other
            fold determines the parameters.
        candidates: number of effects among which the search chooses.
    """

    floor: FloatArray
    independent: FloatArray
    block: NDArray[np.int64]
    fold: NDArray[np.int64]
    part: NDArray[np.int64]
    has_one_recording: bool
    candidates: int

    @classmethod
    def of(
        cls,
        nominal: FloatArray,
        floor: FloatArray,
        lengths: Sequence[int],
        recordings: Sequence[int],
        candidates: int,
    ) -> Comparison:
        """Blocks and folds of the samples of some segments.

        Args:
            nominal: (samples, signals) residual of the nominal model, segments stacked.
            floor: (signals,) noise floor.
            lengths: number of samples of each segment.
            recordings: index of the recording of each segment.
            candidates: number of effects among which the search chooses.
        """
        finite = np.nan_to_num(nominal, posinf=0.0, neginf=0.0)
        independent = effective_samples(finite, lengths)
        mismatched = np.mean(finite**2, axis=0) > (NOISE_FLOORS * floor) ** 2
        if mismatched.any():
            # A signal that the nominal model explains would outweigh all others by its many
            # independent samples.
            typical = float(np.median(independent[mismatched]))
            independent = np.minimum(independent, typical)
        correlation = len(finite) / max(float(independent.min()), 1.0)
        owner = np.repeat(np.asarray(recordings, dtype=np.int64), lengths)
        block = np.empty(len(owner), dtype=np.int64)
        count = 0
        names = np.unique(owner)
        for name in names:
            (own,) = np.nonzero(owner == name)
            wanted = int(len(own) / (_CORRELATION_TIMES * correlation))
            parts = int(np.clip(wanted, _FEWEST_BLOCKS, _MOST_BLOCKS))
            block[own] = count + np.arange(len(own)) * parts // max(len(own), 1)
            count += parts
        is_one = len(names) < 2
        if count == _FEWEST_BLOCKS:
            block = _halves_of_mismatch(finite / floor)
        part = np.empty(len(owner), dtype=np.int64)
        for name in names:
            (own,) = np.nonzero(owner == name)
            part[own] = np.arange(len(own)) * _PARTS_OF_ONE_RECORDING // len(own)
        fold = part if is_one else np.searchsorted(names, owner)
        return cls(floor, independent, block, fold, part, is_one, candidates)

    def penalty(self, size: Size) -> float:
        """Penalty of the log-likelihood for the effects and parameters of a model."""
        for_parameter = 0.5 * np.log(max(float(self.independent.mean()), 2.0))
        return float(
            for_parameter * size.parameters
            + np.log(max(self.candidates, 1)) * size.effects
            + size.surprise
        )

    def log_likelihood(self, mean_square: FloatArray, floors: float = 1.0) -> float:
        """Log-likelihood of (signals,) mean squared residuals; minus infinity if not finite.

        Args:
            floors: noise floors below which residuals count as equal.
        """
        if not np.isfinite(mean_square).all():
            return -np.inf
        known = np.maximum(mean_square, (floors * self.floor) ** 2)
        return float(-0.5 * np.sum(self.independent * np.log(known / self.floor**2)))

    def cross_validated(
        self,
        residual: FloatArray,
        jacobian: FloatArray,
        theta: FloatArray,
        bounds: tuple[FloatArray, FloatArray],
    ) -> FloatArray:
        """(samples, signals) residual of each fold with the parameters of the other folds.

        The parameters without a fold follow from one Gauss-Newton step on the fit to all folds.
        An effect may act in one recording only, such as a limit that only fast motion reaches. The
        others then do not predict it, and each part of it is predicted from all other samples.

        Args:
            residual: (samples, signals) of the fit to all folds.
            jacobian: (samples, signals, parameters) derivative of its prediction.
            theta: (parameters,) its parameters.
            bounds: lower and upper bounds of the parameters.
        """
        self._check(residual)
        if not theta.size or not np.isfinite(residual).all():
            return residual
        weight = 1.0 / (np.mean(residual**2, axis=0) + self.floor**2)
        whole, slope = _sums(residual, jacobian, weight)
        step = _solve(whole, slope, whole)
        left_out = list[NDArray[np.bool_]]()
        for fold in self._folds:
            normal, _ = _sums(residual[fold], jacobian[fold], weight)
            if self.has_one_recording or _is_determined(normal, whole):
                left_out.append(fold)
            else:
                left_out += [fold & (self.part == k) for k in range(_PARTS_OF_ONE_RECORDING)]
        out = residual.copy()
        for own in left_out:
            normal, gradient = _sums(residual[own], jacobian[own], weight)
            change = _solve(whole - normal, slope - gradient, whole) - step
            moved = np.clip(theta + change, *bounds) - theta
            out[own] -= jacobian[own] @ moved
        return out

    def rests_on_one_recording(self, residual: FloatArray, jacobian: FloatArray) -> bool:
        """Whether only one recording determines a parameter.

        Args:
            residual: (samples, signals) of a fit.
            jacobian: (samples, signals, parameters) derivative of its prediction.
        """
        weight = 1.0 / (np.mean(residual**2, axis=0) + self.floor**2)
        whole, _ = _sums(residual, jacobian, weight)
        return self.has_one_recording or not all(
            _is_determined(_sums(residual[fold], jacobian[fold], weight)[0], whole)
            for fold in self._folds
        )

    @property
    def _folds(self) -> list[NDArray[np.bool_]]:
        """Masks of the samples of each fold."""
        return [self.fold == k for k in range(int(self.fold.max()) + 1)]

    def gain(self, residual: FloatArray, over: FloatArray) -> tuple[float, float]:
        """Mean gain of a residual over another one in a block, and its standard error.

        The loss of a block is the sum over signals of half the log of its mean square plus the
        squared noise floor. Infinite gains are those over a simulation that diverged.
        """
        for each in (residual, over):
            self._check(each)
        difference = self._block_losses(over) - self._block_losses(residual)
        if not np.isfinite(difference).all():
            is_gain = np.isfinite(residual).all()
            return (np.inf if is_gain else -np.inf), 0.0
        error = float(np.std(difference, ddof=1)) / np.sqrt(len(difference))
        return float(difference.mean()), error

    def _block_losses(self, residual: FloatArray) -> FloatArray:
        counts = np.bincount(self.block).astype(float)
        mean_square = np.array([
            np.bincount(self.block, weights=column) / counts for column in residual.T**2
        ])  # fmt: skip
        losses: FloatArray = 0.5 * np.log(1.0 + mean_square.T / self.floor**2).sum(axis=1)
        return losses

    def _check(self, residual: FloatArray) -> None:
        expected = (len(self.block), len(self.floor))
        if residual.shape != expected:
            raise IncomparableModelsError(
                f"a model is compared on {residual.shape[0]} samples of {residual.shape[1]} "
                f"signals; expected {expected[0]} samples of {expected[1]} signals"
            )


def _halves_of_mismatch(relative: FloatArray) -> NDArray[np.int64]:
    """(samples,) 0 in the first part of a recording, 1 in the second, with as much mismatch each.

    In halves of the time, an effect that acts in one of them has no gain in the other. The mean
    gain is then as large as its standard error, however large it is.

    Args:
        relative: (samples, signals) residual of the nominal model, in noise floors.
    """
    mismatch = np.cumsum(np.log1p(relative**2).sum(axis=1))
    second = mismatch > 0.5 * mismatch[-1]
    half = len(second) // 2
    if second.all() or not second.any():
        second = np.arange(len(second)) >= half
    return np.asarray(second, dtype=np.int64)


def _sums(
    residual: FloatArray, jacobian: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Normal matrix and gradient of a weighted least-squares problem."""
    return (
        np.einsum("tsp,s,tsq->pq", jacobian, weight, jacobian),
        np.einsum("tsp,s,ts->p", jacobian, weight, residual),
    )


def _is_determined(normal: FloatArray, whole: FloatArray) -> bool:
    """Whether the other folds determine all parameters that a fold with ``normal`` depends on."""
    size = np.sqrt(np.maximum(np.diag(whole), 1e-300))
    own, others = (each / np.outer(size, size) for each in (normal, whole - normal))
    excess = np.linalg.eigvalsh(own - _MOST_OF_ONE_FOLD * others)
    return bool((excess <= _RIDGE).all())


def _solve(normal: FloatArray, right: FloatArray, whole: FloatArray) -> FloatArray:
    """Solution of a normal equation; directions that only ``whole`` determines get no step."""
    size = np.sqrt(np.maximum(np.diag(whole), 1e-300))
    values, vectors = np.linalg.eigh(normal / np.outer(size, size))
    known = values > _RIDGE * max(len(size), 1)
    shares = np.where(known, vectors.T @ (right / size) / np.where(known, values, 1.0), 0.0)
    out: FloatArray = vectors @ shares / size
    return out
