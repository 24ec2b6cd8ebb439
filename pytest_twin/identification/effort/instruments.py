"""Instrumental variables, which remove the bias of least squares from encoder noise.

Position noise is in the regressor and, through the servo, in the effort. Both bias least squares. A
noise-free motion that is correlated with the measured one gives unbiased parameters (Janot,
Vandanjon, Gautier, IEEE Trans. Control Syst. Technol. 22, 2014). Here it is the response of a
linear servo to the position commands, fitted joint by joint (Young's auxiliary model).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from pytest_twin.arrays import FloatArray
from pytest_twin.estimation.covariance import bootstrap_deviations
from pytest_twin.estimation.score import effective_samples
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.blocks import normal_equations
from pytest_twin.identification.effort.filtering import Filter, low_passed, resample_uniformly
from pytest_twin.identification.effort.least_squares import (
    LinearProblem,
    Solution,
    row_weights,
    weight_rows,
)
from pytest_twin.identification.measured_recordings import MeasuredRecording

_ITERATIONS = 3
"""Number of iterations of the row weights, starting from those of least squares."""
_SURE = 0.01
"""Significance level of a difference of the two estimates."""


@dataclass(frozen=True)
class Endogeneity:
    """The test of Durbin, Wu and Hausman (Econometrica 46, 1978).

    Attributes:
        statistic: squared difference of both estimates over its variance under the null hypothesis
            that least squares is unbiased.
        freedom: degrees of freedom of its chi-squared distribution.
        held_out: fraction of the squared residual on held-out recordings that the noise-free motion
            explains, for least squares and for instrumental variables.
    """

    statistic: float
    freedom: int
    held_out: tuple[float, float]

    @property
    def probability(self) -> float:
        """p-value of the statistic."""
        return float(stats.chi2.sf(self.statistic, self.freedom))

    @property
    def is_biased(self) -> bool:
        """Whether least squares is biased and instrumental variables predict better."""
        return self.probability < _SURE and self.held_out[1] < self.held_out[0]

    @property
    def words(self) -> str:
        """Describe the result of the test in one sentence."""
        said = (
            "least squares and instrumental variables (commanded motion) differ by as much as this "
            f"with a probability of {self.probability:.2g}"
        )
        if self.is_biased:
            return f"{said}: noise of the positions biases least squares"
        if self.probability < _SURE:
            return (
                f"{said}, but least squares predicts held-out motion better: an error of the model"
            )
        return said

    def to_json(self) -> dict[str, Any]:
        """Return the entry of ``identification.json``."""
        return {
            "statistic": self.statistic,
            "degrees_of_freedom": self.freedom,
            "probability": self.probability,
            "held_out_least_squares": self.held_out[0],
            "held_out_instrumental": self.held_out[1],
        }


def commanded_motion(recording: MeasuredRecording, chosen: Filter) -> MeasuredRecording | None:
    """Return the recording with noise-free positions: the response of a linear servo to commands.

    position = a + b c + d dc/dt + e d2c/dt2 for each joint: gain, delay and lag of the servo to
    second order. Returns None if a joint has no position command.

    Args:
        recording: recording with its commands.
    """
    if recording.command is None or not np.isfinite(recording.command).all():
        return None
    even = resample_uniformly(recording)
    assert even.command is not None
    rate = recording.rate
    command = low_passed(even.command, chosen.parallel, rate)
    first = np.gradient(command, 1.0 / rate, axis=0)
    second = np.gradient(first, 1.0 / rate, axis=0)
    columns = []
    for k in range(len(even.joints)):
        design = np.column_stack([np.ones(len(command)), command[:, k], first[:, k], second[:, k]])
        design /= np.maximum(np.linalg.norm(design, axis=0), 1e-300)
        gains = np.linalg.lstsq(design, even.position[:, k], rcond=1e-9)[0]
        columns.append(design @ gains)
    return replace(even, position=np.column_stack(columns))


def with_commanded_motion(problem: LinearProblem) -> LinearProblem:
    """Return the problem with the noise-free regressor of the commanded motion."""
    assert problem.instrument is not None
    return replace(problem, matrix=problem.instrument, instrument=None)


def solve_instrumental(problem: LinearProblem, start: Solution) -> Solution:
    """Solve by weighted instrumental variables, (Z^T W)^-1 Z^T y, with robust weights.

    Half widths are at least those of the bootstrap over blocks.

    Args:
        problem: problem with its instrument.
        start: least-squares solution of the same problem.
    """
    assert problem.instrument is not None
    count = problem.matrix.shape[2]
    values, residual, weight, noise = start.values, start.residual, start.weight, start.noise
    for _ in range(_ITERATIONS):
        values = _solve(problem, problem.instrument, weight)
        residual = np.where(problem.known, problem.effort - problem.matrix @ values, 0.0)
        weight, noise = row_weights(problem, residual, values)
    influence = _influence(problem, problem.instrument, weight)
    covariance = _variance(influence, residual, problem)
    equations = normal_equations(problem, weight, problem.instrument)
    between = Z95 * bootstrap_deviations(*equations)
    half = np.maximum(Z95 * np.sqrt(np.diag(covariance)), between)
    unit = weight_rows(problem.instrument, weight)
    unit = unit / np.maximum(np.linalg.norm(unit, axis=0), 1e-300)
    condition = float(np.linalg.cond(np.linalg.qr(unit, mode="r"))) if count else 1.0
    return Solution(values, covariance, noise, residual, weight, condition, half)


def endogeneity(
    problem: LinearProblem, tested: LinearProblem, squares: Solution, instruments: Solution
) -> Endogeneity:
    """Test whether both estimates differ by more than they would without noise in the regressor.

    Under the null hypothesis the difference is linear in the residual of least squares, whose
    variance uses the effective sample size of each joint (Geyer 1992).

    Args:
        problem: problem on the fitted recordings, with its instrument.
        tested: problem on the held-out recordings, or the same.
    """
    assert problem.instrument is not None
    weight = squares.weight
    values = _solve(problem, problem.instrument, weight)
    influence = _influence(problem, problem.instrument, weight) - _influence(
        problem, problem.matrix, weight
    )
    variance = _variance(influence, squares.residual, problem)
    off = values - squares.values
    sizes = np.sqrt(np.diag(variance).clip(1e-300))
    own, axes = np.linalg.eigh(variance / np.outer(sizes, sizes))
    sound = own > 1e-6 * own.max(initial=0.0)
    along = (axes.T @ (off / sizes))[sound]
    return Endogeneity(
        float(np.sum(along**2 / own[sound])),
        int(sound.sum()),
        (_explained_share(tested, squares), _explained_share(tested, instruments)),
    )


def _solve(problem: LinearProblem, instrument: FloatArray, weight: FloatArray) -> FloatArray:
    """(b,) parameters of the weighted normal equations Z^T W x = Z^T y."""
    z, w = weight_rows(instrument, weight), weight_rows(problem.matrix, weight)
    sizes = np.maximum(np.linalg.norm(w, axis=0), 1e-300)
    rows, right = z.T @ w, z.T @ (problem.effort * weight).ravel()
    scaled = rows / np.outer(sizes, sizes)
    return np.asarray(np.linalg.lstsq(scaled, right / sizes, rcond=None)[0] / sizes)


def _influence(problem: LinearProblem, instrument: FloatArray, weight: FloatArray) -> FloatArray:
    """(b, n * joints) derivative of the estimate by each effort."""
    z, w = weight_rows(instrument, weight), weight_rows(problem.matrix, weight)
    sizes = np.maximum(np.linalg.norm(w, axis=0), 1e-300)
    scaled = np.linalg.pinv((z.T @ w) / np.outer(sizes, sizes))
    return np.asarray((scaled / sizes[:, None]) @ (z / sizes).T * weight.ravel())


def _variance(influence: FloatArray, residual: FloatArray, problem: LinearProblem) -> FloatArray:
    """(b, b) covariance of ``influence @ residual``, for residuals correlated in time."""
    rows, joints = residual.shape
    effective = np.maximum(effective_samples(residual, problem.lengths), 2.0)
    each = influence.reshape(len(influence), rows, joints)
    total = np.zeros((len(influence), len(influence)))
    for j in range(joints):
        known = problem.known[:, j]
        if known.any():
            power = float(np.mean(residual[known, j] ** 2)) * max(rows / effective[j], 1.0)
            total += power * each[:, :, j] @ each[:, :, j].T
    return total


def _explained_share(tested: LinearProblem, solution: Solution) -> float:
    """Fraction of the weighted squared residual that the instrument's columns explain."""
    assert tested.instrument is not None
    weight = np.where(tested.known & np.isfinite(solution.noise), 1.0, 0.0)
    weight = np.where(tested.resting, 0.0, weight / np.where(
        np.isfinite(solution.noise), solution.noise, 1.0
    ))  # fmt: skip
    residual = ((tested.effort - tested.matrix @ solution.values) * weight).ravel()
    z = weight_rows(tested.instrument, weight)
    basis, triangle = np.linalg.qr(z / np.maximum(np.linalg.norm(z, axis=0), 1e-300))
    sound = np.abs(np.diag(triangle)) > 1e-8
    return float(np.sum((basis[:, sound].T @ residual) ** 2))


def instruments_of(
    recordings: Sequence[MeasuredRecording], chosen: Filter
) -> list[MeasuredRecording] | None:
    """Return the commanded motion of every recording; None if one has none."""
    found = [one for each in recordings if (one := commanded_motion(each, chosen)) is not None]
    return found if len(found) == len(recordings) else None
