"""The laws that measured efforts show, and their rows along several recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.identification.effort.effort_scale import known_payload
from pytest_twin.identification.effort.filtering import Filter, choose_filter, differentiate
from pytest_twin.identification.effort.law_columns import EffortLaws, EffortRows
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.realization import Realization
from pytest_twin.realization.inverse_dynamics import InverseDynamics

_BANDWIDTH = 5.0
"""Largest bandwidth of the comparison, Hz. Arms move below it; above it efforts are noise of the
encoders and of the drives' control."""
_OVERSAMPLED = 15.0
"""Smallest ratio of the sampling rate to the bandwidth: central differences then lose 3 %."""
_POSITIONS, _RATE = 4.0, 2.5
"""Cutoff of the positions and rate of the rows, relative to the bandwidth."""
_REST = 0.002
"""Fraction of a joint's largest speed below which the direction of dry friction is unknown."""


def band_of(recordings: Sequence[MeasuredRecording]) -> Filter:
    """One filter for all recordings: efforts at other rates are compared in the same band."""
    slowest = min(one.rate for one in recordings)
    band = min(choose_filter(recordings).parallel, _BANDWIDTH, slowest / _OVERSAMPLED)
    return Filter(_POSITIONS * band, band, _RATE * band)


@dataclass(frozen=True)
class LawsAlong:
    """The laws that efforts show, with what their rows along recordings need.

    Attributes:
        laws: the laws; their typical sizes are those of some recordings.
        chosen: filter of all rows.
        rest: (joints,) speeds below which the direction of dry friction is unknown, rad/s or m/s.
    """

    realization: Realization
    laws: EffortLaws
    chosen: Filter
    rest: FloatArray

    @classmethod
    def of(
        cls, realization: Realization, recordings: Sequence[MeasuredRecording], chosen: Filter
    ) -> LawsAlong:
        """The laws, with their typical sizes in some recordings."""
        motions = [differentiate(one, chosen) for one in recordings]
        position = np.concatenate([m.position for m in motions])
        speed = np.maximum(rms_of([m.velocity for m in motions]), 1e-3)
        effort = np.maximum(rms_of([m.effort for m in motions]), 1e-4)
        travel = np.maximum(position.std(axis=0), 1e-2)
        fastest = np.max([np.abs(m.velocity).max(axis=0) for m in motions], axis=0)
        acceleration = np.maximum(rms_of([m.acceleration for m in motions]), 1e-2)
        longest = max(float(one.time[-1]) for one in recordings)
        laws = EffortLaws(realization, recordings[0].joints, {
            "effort": effort, "velocity": speed, "position": travel, "damping": effort / speed,
            "stiffness": effort / travel, "drag": effort / speed**2,
            "inertia": effort / acceleration, "compliance": travel / effort,
            "twelfth": np.full(len(effort), longest / 12.0),
        })  # fmt: skip
        return cls(realization, laws, chosen, np.maximum(_REST * fastest, 1e-9))

    def rows(self, recordings: Sequence[MeasuredRecording]) -> list[EffortRows]:
        """Rows of every recording; the effort of a declared payload belongs to the model."""
        payloads: dict[str, FloatArray] = {}
        rows = []
        for one in recordings:
            payload = known_payload(self.realization, one)
            if payload is not None and payload not in payloads:
                variant = self.realization.variant(payload=payload)
                loaded = InverseDynamics(variant, self.laws.joints)
                payloads[payload] = loaded.parameters - self.laws.dynamics.parameters
            carried = None if payload is None else payloads[payload]
            rows.append(self.laws.rows(one, self.chosen, self.rest, carried))
        return rows


def rms_of(values: Sequence[FloatArray]) -> FloatArray:
    """(columns,) RMS of all known values."""
    return np.asarray(np.sqrt(np.nan_to_num(np.nanmean(np.concatenate(values) ** 2, axis=0))))
