"""Estimate the scale of each joint's effort (its torque constant) from known payloads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.estimation.score import effective_samples
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.essential_parameters import SIGNIFICANT
from pytest_twin.identification.effort.filtering import Filter
from pytest_twin.identification.effort.recording_rows import RecordingRows, sample
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.identification.regressor import Regressor
from pytest_twin.realization import Realization

_LEAST_SHARE = 0.01
"""Smallest fraction of the effort that a payload must add, beyond what robot parameters can
explain, to determine the scale."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Ratio of recorded to true effort of one joint.

    Attributes:
        value: ratio; 1 if the recorded effort is correct.
        half_width: half width of the 95 % interval.
    """

    value: float
    half_width: float

    @property
    def is_significant(self) -> bool:
        """Whether the ratio differs significantly from 1."""
        return abs(self.value - 1.0) * Z95 >= SIGNIFICANT * self.half_width


def payload_effort(
    realization: Realization,
    regressor: Regressor,
    recording: MeasuredRecording,
    rows: RecordingRows,
) -> FloatArray | None:
    """(n, joints) effort of a known payload of the recording; None without a payload.

    Raises:
        SpecError: the payload names a body that the model lacks.
    """
    added = payload_parameters(realization, regressor, recording)
    return None if added is None else np.asarray(rows.matrix @ added)


def known_payload(realization: Realization, recording: MeasuredRecording) -> str | None:
    """Return the payload of a recording if the twin states it, else None."""
    payload = recording.metadata.get("payload")
    stated = () if realization.twin is None else realization.twin.payloads
    return payload if payload is not None and payload in stated else None


def payload_parameters(
    realization: Realization, regressor: Regressor, recording: MeasuredRecording
) -> FloatArray | None:
    """(p,) change of the parameters by a known payload of the recording; None without a payload.

    Raises:
        SpecError: the payload names a body that the model lacks.
    """
    payload = known_payload(realization, recording)
    if payload is None:
        return None
    loaded = Regressor(realization.variant(payload=payload), regressor.joints)
    change = loaded.prior - Regressor(realization, regressor.joints).prior
    at = {column.name: k for k, column in enumerate(regressor.columns)}
    found = np.zeros(len(regressor.columns))
    found[[at[column.name] for column in loaded.columns]] = change
    return found


def payload_scales(
    realization: Realization,
    recordings: Sequence[MeasuredRecording],
    regressor: Regressor,
    chosen: Filter,
) -> dict[str, Scale]:
    """Joint -> scale of its effort, where recordings with different known payloads determine it.

    Each joint is fitted alone: ``effort = scale (W p + payload)``. All parameters ``p`` of the
    robot are free. So the scale follows only from the part of the payload's effort that these
    parameters cannot explain.

    Args:
        realization: the nominal model, with the twin that states the payloads.
        regressor: regressor of the robot without payload, ``W``.
        chosen: low-pass filter of regressor and effort.
    """
    if all(known_payload(realization, one) is None for one in recordings):
        return {}
    rows = sample(recordings, [regressor] * len(recordings), chosen)
    added = [
        payload_effort(realization, regressor, one, own)
        for one, own in zip(recordings, rows, strict=True)
    ]
    known = np.concatenate([
        np.zeros_like(own.effort) if one is None else one
        for one, own in zip(added, rows, strict=True)
    ])  # fmt: skip
    effort = np.concatenate([own.effort for own in rows])
    matrix = np.concatenate([own.matrix for own in rows])
    saturated = np.concatenate([own.saturated | own.resting for own in rows])
    found = {}
    for k, joint in enumerate(regressor.joints):
        use = np.isfinite(effort[:, k]) & ~saturated[:, k]
        lengths = [int(n) for n in _lengths(use, rows) if n]
        if use.sum() > 2 * matrix.shape[2]:
            scale = _scale(matrix[use, k], known[use, k], effort[use, k], lengths)
            if scale is not None:
                found[joint] = scale
    return found


def divide_by_scales(
    recordings: Sequence[MeasuredRecording], scales: Mapping[str, Scale]
) -> tuple[MeasuredRecording, ...]:
    """Return the recordings with the efforts divided by the scales of their joints."""
    return tuple(
        replace(
            one,
            effort=one.effort
            / np.array([scales[j].value if j in scales else 1.0 for j in one.joints]),
        )
        for one in recordings
    )


def _lengths(use: np.ndarray, rows: Sequence[RecordingRows]) -> list[int]:
    ends = np.cumsum([len(own.time) for own in rows])
    starts = [0, *ends[:-1]]
    return [int(use[a:b].sum()) for a, b in zip(starts, ends, strict=True)]


def _scale(
    matrix: FloatArray, known: FloatArray, effort: FloatArray, lengths: Sequence[int]
) -> Scale | None:
    """Return the scale of one joint; None if its own parameters can explain the payload's effort.

    Args:
        matrix: (n, p) regressor rows of the joint.
        known: (n,) effort of the known payloads, N*m or N.
        effort: (n,) recorded effort, in its unit.
        lengths: number of rows of each recording.
    """
    sizes = np.linalg.norm(matrix, axis=0)
    basis, singular, _ = np.linalg.svd(matrix[:, sizes > 0] / sizes[sizes > 0], full_matrices=False)
    basis = basis[:, singular > 1e-8 * singular[0]]
    beside = known - basis @ (basis.T @ known)
    if np.linalg.norm(beside) < _LEAST_SHARE * np.linalg.norm(effort):
        return None
    power = float(beside @ beside)
    value = float(beside @ effort) / power
    residual = effort - basis @ (basis.T @ effort) - value * beside
    independent = max(float(effective_samples(residual[:, None], lengths)[0]), 2.0)
    noise = float(np.sqrt(np.mean(residual**2) * len(residual) / independent))
    return Scale(value, Z95 * noise / np.sqrt(power))
