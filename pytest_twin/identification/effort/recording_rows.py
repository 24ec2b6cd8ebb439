"""Recordings as rows of a linear problem: regressor, effort, and joints at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.identification.effort.filtering import (
    OVERSAMPLED,
    Filter,
    Motion,
    decimate,
    differentiate,
)
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.identification.regressor import Regressor

_EDGE = 1.0
"""Time at both ends that is left out because of filter transients, in periods of the parallel
filter."""
_REST = 0.002
"""Fraction of a joint's largest speed below which the direction of dry friction is unknown."""


@dataclass(frozen=True)
class RecordingRows:
    """Rows of one recording at the rate of the fit.

    Attributes:
        time: (n,) s.
        matrix: (n, joints, p) derivative of the effort by each parameter.
        effort: (n, joints) measured effort with the known efforts of the model added, N*m or N; NaN
            where it is unknown.
        velocity: (n, joints) rad/s or m/s.
        resting: (n, joints) True where the joint is at rest.
        saturated: (n, joints) True where the drive is at its effort limit.
        rest: (joints,) speeds below which a joint is at rest.
        instrument: (n, joints, p) ``matrix`` for the noise-free commanded motion; None without
            position commands of every joint.
    """

    name: str
    time: FloatArray
    matrix: FloatArray
    effort: FloatArray
    velocity: FloatArray
    resting: NDArray[np.bool_]
    saturated: NDArray[np.bool_]
    rest: FloatArray
    instrument: FloatArray | None = None


def sample(
    recordings: Sequence[MeasuredRecording],
    regressors: Sequence[Regressor],
    chosen: Filter,
    commanded: Sequence[MeasuredRecording] | None = None,
    rest: FloatArray | None = None,
    oversampled: float = OVERSAMPLED,
) -> list[RecordingRows]:
    """Rows of every recording.

    Args:
        recordings: recordings with the joints of the regressors.
        regressors: regressor of each recording, which may have its own payload.
        commanded: the same recordings with noise-free motion, for an instrument.
        rest: (joints,) speeds below which a joint is at rest; by default those of the recordings.
        oversampled: ratio of the rate of the regressors to that of the rows, at least.
    """
    motions = [differentiate(one, chosen, oversampled) for one in recordings]
    rest = _rest_speeds(motions) if rest is None else rest
    rows = [
        _rows(one, motion, regressor, chosen, rest)
        for one, motion, regressor in zip(recordings, motions, regressors, strict=True)
    ]
    if commanded is None:
        return rows
    return [
        replace(own, instrument=_matrix(differentiate(one, chosen), regressor, chosen, rest))
        for own, one, regressor in zip(rows, commanded, regressors, strict=True)
    ]


def encoder_slopes(
    recordings: Sequence[MeasuredRecording],
    regressor: Regressor,
    chosen: Filter,
    parameters: Sequence[FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Return the changes of the predicted effort with the errors of all encoders.

    Args:
        recordings: recordings with the joints of the regressor.
        parameters: (p,) parameters of each recording.

    Returns:
        (n, joints, joints) by the zeros, N*m/rad or N/m, and the same by the relative errors of
        the scales; rows as in :func:`sample`, the last index is the joint of the encoder.
    """
    motions = [differentiate(one, chosen) for one in recordings]
    rest = _rest_speeds(motions)
    zeros, scales = [], []
    for motion, own in zip(motions, parameters, strict=True):
        moving = _moving(motion, rest)
        by_position, by_velocity, by_acceleration = regressor.derivatives(
            motion.position, moving, motion.acceleration, own, motion.base
        )
        # The true position is (measured - zero) / (1 + scale).
        zeros.append(inner_rows(-by_position, motion, chosen))
        by_scale = (
            by_position * motion.position[:, None]
            + by_velocity * moving[:, None]
            + by_acceleration * motion.acceleration[:, None]
        )
        scales.append(inner_rows(-by_scale, motion, chosen))
    return np.concatenate(zeros), np.concatenate(scales)


def _rest_speeds(motions: Sequence[Motion]) -> FloatArray:
    """(joints,) speeds below which the direction of dry friction is unknown."""
    fastest = np.max([np.abs(m.velocity).max(axis=0) for m in motions], axis=0)
    return np.asarray(np.maximum(_REST * fastest, 1e-9))


def _rows(
    recording: MeasuredRecording,
    motion: Motion,
    regressor: Regressor,
    chosen: Filter,
    rest: FloatArray,
) -> RecordingRows:
    velocity = decimate(motion.velocity, motion.rate, chosen)
    top = np.abs(motion.effort) >= 0.98 * recording.limit
    inner = _inner(len(velocity), chosen)
    effort = motion.effort + known_efforts_along(recording, motion, rest)
    return RecordingRows(
        name=recording.path.name,
        time=motion.time[:: max(1, round(motion.rate / chosen.rate))][inner],
        matrix=_matrix(motion, regressor, chosen, rest),
        effort=decimate(effort, motion.rate, chosen)[inner],
        velocity=velocity[inner],
        resting=(np.abs(velocity) <= rest)[inner],
        saturated=(decimate(top.astype(np.float64), motion.rate, chosen) > 0.01)[inner],
        rest=rest,
    )


def _moving(motion: Motion, rest: FloatArray) -> FloatArray:
    """(n, joints) velocities, 0 at rest."""
    return np.where(np.abs(motion.velocity) > rest, motion.velocity, 0.0)


def known_efforts_along(
    recording: MeasuredRecording, motion: Motion, rest: FloatArray
) -> FloatArray:
    """(n, joints) known efforts; 0 where the effort is a current of unknown torque constant."""
    if recording.known is None:
        return np.zeros_like(motion.effort)
    moving = _moving(motion, rest)
    time = recording.start + motion.time
    found = recording.known.along(
        time, (motion.position, moving), motion.effort, recording, motion.base
    )
    return np.where(recording.unscaled, 0.0, found)


def _matrix(motion: Motion, regressor: Regressor, chosen: Filter, rest: FloatArray) -> FloatArray:
    matrix = regressor.matrix(
        motion.position, _moving(motion, rest), motion.acceleration, motion.base
    )
    return inner_rows(matrix, motion, chosen)


def inner_rows(values: FloatArray, motion: Motion, chosen: Filter) -> FloatArray:
    """Decimate (n, ...) values to the rate of the fit and cut off the edges."""
    found = decimate(values, motion.rate, chosen)
    return np.asarray(found[_inner(len(found), chosen)])


def _inner(count: int, chosen: Filter) -> slice:
    """Return the slice of rows without the edges."""
    edge = int(np.ceil(_EDGE * chosen.rate / chosen.parallel))
    return slice(edge, max(count - edge, edge + 1))
