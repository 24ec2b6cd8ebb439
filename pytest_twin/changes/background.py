"""What earlier recordings show of a robot, and what they leave of later ones.

The earlier recordings measure every law of the catalogue at once: amplitudes have a Gaussian prior
(ridge), and their estimate and covariance are carried into the later recordings. There they are
nuisance parameters and marginalized, so an error of the model that was there before is no change
(Basseville, Automatica 33, 1997; Döhler, Mevel, Zhang, Annual Reviews in Control 42, 2016).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.changes.scatter import AMPLITUDE_PRIOR, Scatter, SessionSums


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
        sums: for each recording and joint, the sums of its scaled rows.
        largest: (columns,) largest possible change of each amplitude, relative to the RMS effort.
        not_negative: (columns,) whether an amplitude cannot be negative, such as the extra friction
            at rest.
    """

    parts: tuple[RecordedRows, ...]
    size: FloatArray
    scale: FloatArray
    sums: tuple[tuple[SessionSums, ...], ...]
    largest: FloatArray
    not_negative: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        parts: Sequence[RecordedRows],
        size: FloatArray,
        count: int,
        largest: FloatArray | None = None,
        not_negative: NDArray[np.bool_] | None = None,
    ) -> Rows:
        """Sum the rows of recordings.

        Args:
            count: number of columns.
            largest: (columns,) largest possible change of each amplitude, SI units; None for any.
            not_negative: (columns,) whether an amplitude cannot be negative; None if all can.
        """
        rms = np.zeros(count)
        for j in range(len(size)):
            power, samples = np.zeros(count), 0
            for part in parts:
                power[part.columns[j]] += (part.matrix[j] ** 2).sum(axis=0)
                samples += len(part.time)
            rms = np.maximum(rms, np.sqrt(power / max(samples, 1)) / size[j])
        scale = 1.0 / np.where(rms > 0.0, rms, np.inf)
        # A column without effort in one recording is missing there.
        acting = [
            np.unique(np.concatenate([p.columns[j] for p in parts])) for j in range(len(size))
        ]
        sums = tuple(
            tuple(_sums(part, j, columns, scale) for j, columns in enumerate(acting))
            for part in parts
        )
        limits = np.full(count, np.inf) if largest is None else largest
        limits = limits / np.where(scale > 0.0, scale, 1.0)
        one_sided = np.zeros(count, dtype=bool) if not_negative is None else not_negative
        return cls(tuple(parts), size, scale, sums, limits, one_sided)

    def sums_of(self, session: Sequence[int]) -> list[SessionSums]:
        """For each joint, the sums over the recordings of a session."""
        return [
            SessionSums.total([self.sums[i][j] for i in session]) for j in range(len(self.size))
        ]

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

    def residual_rms(self, which: Sequence[int], amplitudes: FloatArray) -> FloatArray:
        """(joints,) RMS residual of some recordings."""
        residual = np.concatenate(self.residuals(which, amplitudes))
        return np.asarray(np.sqrt(np.mean(residual**2, axis=0)))


def _sums(
    part: RecordedRows, joint: int, columns: NDArray[np.intp], scale: FloatArray
) -> SessionSums:
    known = np.isfinite(part.effort[:, joint])
    rows = np.zeros((int(known.sum()), len(columns)))
    rows[:, np.searchsorted(columns, part.columns[joint])] = part.matrix[joint][known]
    rows *= scale[columns]
    effort = part.effort[known, joint]
    return SessionSums(columns, rows.T @ rows, rows.T @ effort, float(effort @ effort), len(effort))


@dataclass(frozen=True)
class Information:
    """What sessions show of all amplitudes, with the scatter between sessions taken into account.

    Attributes:
        matrix: (p, p) information, relative to the RMS effort.
        vector: (p,) right side of the normal equations.
    """

    matrix: FloatArray
    vector: FloatArray

    @classmethod
    def of(
        cls, sessions: Sequence[SessionSums], scatter: Sequence[Scatter], count: int
    ) -> Information:
        """Information of one session.

        Args:
            sessions: its sums for each joint.
            scatter: the scatter of each joint.
            count: number of columns.
        """
        matrix, vector = np.zeros((count, count)), np.zeros(count)
        for sums, joint_scatter in zip(sessions, scatter, strict=True):
            joint_matrix, joint_vector = joint_scatter.information(sums)
            matrix[np.ix_(sums.columns, sums.columns)] += joint_matrix
            vector[sums.columns] += joint_vector
        return cls(matrix, vector)

    @classmethod
    def total(cls, each: Sequence[Information]) -> Information:
        """Information of independent sessions together."""
        return cls(
            np.sum([info.matrix for info in each], axis=0),
            np.sum([info.vector for info in each], axis=0),
        )


@dataclass(frozen=True)
class Background:
    """Amplitudes of all laws as earlier recordings show them.

    Attributes:
        mean: (p,) estimate, relative to the RMS effort.
        precision: (p, p) inverse of the covariance.
    """

    mean: FloatArray
    precision: FloatArray

    @classmethod
    def of(cls, information: Information) -> Background:
        """Estimate from the information of the earlier sessions and the prior."""
        precision = information.matrix + np.eye(len(information.vector)) / AMPLITUDE_PRIOR**2
        mean = np.asarray(np.linalg.solve(precision, information.vector), dtype=np.float64)
        return cls(mean, precision)

    def deviation(self, columns: NDArray[np.intp]) -> FloatArray:
        """(k,) standard deviation of some amplitudes."""
        of_columns = np.linalg.solve(self.precision, np.eye(len(self.mean))[:, columns])
        return np.asarray(np.sqrt(np.diag(of_columns[columns])))


@dataclass(frozen=True)
class Contrast:
    """What later sessions show of a change, whatever the background is.

    Attributes:
        information: (p, p) information on the change of each amplitude, all others unchanged and
            the background marginalized.
        vector: (p,) right side of the normal equations of the change.
    """

    information: FloatArray
    vector: FloatArray

    @classmethod
    def of(cls, later: Information, background: Background) -> Contrast:
        """Later sessions against the background."""
        rest = later.vector - later.matrix @ background.mean
        removed = np.linalg.solve(background.precision + later.matrix, later.matrix)
        return cls(later.matrix - later.matrix @ removed, rest - removed.T @ rest)

    def without(self, columns: NDArray[np.intp], change: FloatArray) -> Contrast:
        """The contrast after a change of these amplitudes."""
        return Contrast(self.information, self.vector - self.information[:, columns] @ change)
