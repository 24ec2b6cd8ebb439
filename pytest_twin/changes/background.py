"""What earlier recordings show of a robot, and what they leave of later ones.

The efforts of the earlier recordings measure every law of the catalogue at once: amplitudes have a
Gaussian prior (ridge), and their estimate and covariance are the prior of the later recordings. An
error of the model that was there before is therefore no change (Basseville, Automatica 33, 1997;
Döhler, Mevel, Zhang, Annual Reviews in Control 42, 2016: nuisance parameters, marginalized). Only
the difference is scored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.estimation.score import effective_samples
from pytest_twin.identification.effort.law_columns import Shape

_PRIORS = (0.02, 0.06, 0.2)
"""Possible standard deviations of an amplitude before any recording: its effort relative to the RMS
effort of the joint. The one with which recordings predict each other best is used."""
_ITERATIONS = 3
"""Number of estimates of the noise."""
_LEAST_NOISE = 1e-4
"""Smallest noise relative to the RMS effort: simulated recordings have none."""
_FIRST_NOISE = 0.3
"""Noise relative to the RMS effort with which the estimates of the noise begin."""
_RIDGE, _LEAST_RIDGE = 1e-9, 1e-12
"""Relative size that keeps the equations of a single law solvable, and the least size for a law
that does not act in these recordings."""


class RecordedRows(Protocol):
    """Rows of one recording, joint by joint: of efforts, or of positions."""

    @property
    def recording(self) -> Any:
        """The recording, with ``path``, ``start`` and ``metadata``."""

    @property
    def time(self) -> FloatArray:
        """(n,) s."""

    @property
    def effort(self) -> FloatArray:
        """(n, joints) what the model leaves; NaN where unknown."""

    @property
    def columns(self) -> tuple[NDArray[np.intp], ...]:
        """For each joint, (k,) indices of the columns that act on it."""

    @property
    def matrix(self) -> tuple[FloatArray, ...]:
        """For each joint, (n, k) change per unit of these amplitudes."""


@dataclass(frozen=True)
class Rows:
    """Recordings with the sums over their rows, joint by joint.

    Attributes:
        parts: the recordings.
        size: (joints,) RMS effort of each joint, N*m or N; amplitudes are relative to it.
        scale: (columns,) amplitude in SI units whose effort is the RMS effort of a joint.
        sums: for each recording and joint, (k, k) and (k,) sums of scaled rows.
    """

    parts: tuple[RecordedRows, ...]
    size: FloatArray
    scale: FloatArray
    sums: tuple[tuple[tuple[FloatArray, FloatArray], ...], ...]

    @classmethod
    def of(cls, parts: Sequence[RecordedRows], size: FloatArray, count: int) -> Rows:
        """Sum the rows of recordings.

        Args:
            count: number of columns.
        """
        largest = np.zeros(count)
        for j in range(len(size)):
            power, rows = np.zeros(count), 0
            for part in parts:
                power[part.columns[j]] += (part.matrix[j] ** 2).sum(axis=0)
                rows += len(part.time)
            largest = np.maximum(largest, np.sqrt(power / max(rows, 1)) / size[j])
        scale = 1.0 / np.where(largest > 0.0, largest, np.inf)
        sums = tuple(tuple(_sums(part, j, scale) for j in range(len(size))) for part in parts)
        return cls(tuple(parts), size, scale, sums)

    def equations(self, which: Sequence[int], weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(p, p) and (p,) normal equations of some recordings.

        Args:
            weight: (joints,) weight of a squared residual, 1/(N*m)^2 or 1/N^2.
        """
        count = len(self.scale)
        matrix, vector = np.zeros((count, count)), np.zeros(count)
        for i in which:
            for j, (own, right) in enumerate(self.sums[i]):
                columns = self.parts[i].columns[j]
                matrix[np.ix_(columns, columns)] += weight[j] * own
                vector[columns] += weight[j] * right
        return matrix, vector

    def effort_of(self, i: int, amplitudes: FloatArray) -> FloatArray:
        """(n, joints) effort of amplitudes along a recording, N*m or N."""
        part = self.parts[i]
        return np.stack(
            [
                matrix @ (self.scale[columns] * amplitudes[columns])
                for matrix, columns in zip(part.matrix, part.columns, strict=True)
            ],
            axis=1,
        )

    def residuals(self, which: Sequence[int], amplitudes: FloatArray) -> list[FloatArray]:
        """(n, joints) residual of each of some recordings, 0 where the effort is unknown."""
        return [np.nan_to_num(self.parts[i].effort - self.effort_of(i, amplitudes)) for i in which]


def _sums(part: RecordedRows, joint: int, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
    known = np.isfinite(part.effort[:, joint])
    rows = part.matrix[joint][known] * scale[part.columns[joint]]
    return rows.T @ rows, rows.T @ part.effort[known, joint]


@dataclass(frozen=True)
class Background:
    """Amplitudes of all laws as earlier recordings show them.

    Attributes:
        mean: (p,) estimate, relative to the RMS effort.
        precision: (p, p) inverse of the covariance.
        vector: (p,) right side of the equations, ``precision @ mean``.
        weight: (joints,) weight of a squared residual.
    """

    mean: FloatArray
    precision: FloatArray
    vector: FloatArray
    weight: FloatArray

    def without(self, rows: Rows, which: Sequence[int]) -> Background:
        """The same without some of its recordings."""
        matrix, vector = rows.equations(which, self.weight)
        precision, rest = self.precision - matrix, self.vector - vector
        mean = scipy.linalg.solve(precision, rest, assume_a="pos")
        return Background(mean, precision, rest, self.weight)

    def covariance(self) -> FloatArray:
        """(p, p) covariance of the amplitudes."""
        return np.asarray(np.linalg.inv(self.precision), dtype=np.float64)


def background_of(rows: Rows, sessions: Sequence[Sequence[int]]) -> Background:
    """Estimate the amplitudes of all laws from the recordings of several sessions."""

    def error(background: Background) -> float:
        """Squared residual of sessions that are left out, all joints alike."""
        left_out = [
            residual / rows.size
            for session in sessions
            for residual in rows.residuals(session, background.without(rows, session).mean)
        ]
        return float((np.concatenate(left_out) ** 2).sum())

    which = [i for session in sessions for i in session]
    return min((_background_of(rows, which, prior) for prior in _PRIORS), key=error)


def _background_of(rows: Rows, which: Sequence[int], prior: float) -> Background:
    """Estimate the amplitudes of all laws with one standard deviation of their prior.

    Residuals are correlated in time; the weight of a joint is that of its independent samples.
    """
    ridge = np.eye(len(rows.scale)) / prior**2
    weight = 1.0 / np.maximum(_FIRST_NOISE * rows.size, 1e-12) ** 2
    for step in range(_ITERATIONS + 1):
        matrix, vector = rows.equations(which, weight)
        precision = matrix + ridge
        mean = scipy.linalg.solve(precision, vector, assume_a="pos")
        if step == _ITERATIONS:
            break
        residuals = rows.residuals(which, mean)
        stacked = np.concatenate(residuals)
        noise = np.maximum(np.sqrt(np.mean(stacked**2, axis=0)), _LEAST_NOISE * rows.size)
        independent = effective_samples(stacked, [len(r) for r in residuals])
        weight = independent / len(stacked) / noise**2
    return Background(mean, precision, vector, weight)


@dataclass(frozen=True)
class Remainder:
    """What a background leaves of the efforts of other recordings, as sums for each joint.

    Attributes:
        samples: number of rows.
        power: (joints,) sum of squared residuals, (N*m)^2 or N^2.
        matrix: (joints, p, p) sums of products of scaled columns.
        vector: (joints, p) sums of products of columns and residual.
        least: (joints,) smallest mean squared residual that is not rounding.
    """

    samples: int
    power: FloatArray
    matrix: FloatArray
    vector: FloatArray
    least: FloatArray

    @classmethod
    def of(cls, rows: Rows, which: Sequence[int], background: Background) -> Remainder:
        """What the background leaves of some recordings."""
        joints, count = len(rows.size), len(rows.scale)
        matrix, vector = np.zeros((joints, count, count)), np.zeros((joints, count))
        for i in which:
            for j, (own, right) in enumerate(rows.sums[i]):
                columns = rows.parts[i].columns[j]
                matrix[j][np.ix_(columns, columns)] += own
                vector[j, columns] += right
        vector -= matrix @ background.mean
        residual = np.concatenate(rows.residuals(which, background.mean))
        least = (_LEAST_NOISE * rows.size) ** 2
        power = np.maximum((residual**2).sum(axis=0), least * len(residual))
        return cls(len(residual), power, matrix, vector, least)

    def fit(self, columns: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """(k,) amplitudes that reduce the residual most, and (k, k) their information per sample.

        Each joint has the weight of its own mean squared residual.
        """
        information = _solvable(np.einsum("j,jab->ab", 1.0 / self.power, self._own(columns)))
        right = (1.0 / self.power) @ self.vector[:, columns]
        return np.asarray(np.linalg.solve(information, right)), information

    def seeming_covariances(
        self, shapes: Sequence[Shape], covariance: FloatArray
    ) -> list[FloatArray]:
        """For each shape, (k, k) covariance of the change that only an unknown background causes.

        It is large where the motion moves what earlier motions did not.

        Args:
            covariance: (p, p) covariance of the background.
        """
        information = np.einsum("j,jab->ab", 1.0 / self.power, self.matrix)
        spread = information @ covariance @ information
        covariances = []
        for shape in shapes:
            square = np.ix_(shape.indices, shape.indices)
            inverse = np.linalg.inv(_solvable(information[square]))
            covariances.append(inverse @ spread[square] @ inverse)
        return covariances

    def power_after(self, columns: NDArray[np.intp], change: FloatArray) -> FloatArray:
        """(joints,) sum of squared residuals after a change of these amplitudes."""
        after: FloatArray = self.power - 2.0 * self.vector[:, columns] @ change
        after = after + np.einsum("a,jab,b->j", change, self._own(columns), change)
        return np.maximum(after, self.least * self.samples)

    def after(self, columns: NDArray[np.intp], change: FloatArray) -> Remainder:
        """The remainder after a change of these amplitudes."""
        vector = self.vector - self.matrix[:, :, columns] @ change
        power = self.power_after(columns, change)
        return Remainder(self.samples, power, self.matrix, vector, self.least)

    def _own(self, columns: NDArray[np.intp]) -> FloatArray:
        return self.matrix[:, columns[:, None], columns]


def _solvable(information: FloatArray) -> FloatArray:
    """(k, k) information of a law with the ridge that lets it be solved."""
    ridge = _RIDGE * np.trace(information) + _LEAST_RIDGE
    return np.asarray(information + ridge * np.eye(len(information)))
