"""A realization's prediction of effort, on recordings that an identification held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pytest_twin.errors import RecordingError
from pytest_twin.formats.identification_record import IdentificationRecord
from pytest_twin.identification.effort.encoders import BIAS, SCALE, Reading, without_errors
from pytest_twin.identification.effort.filtering import Filter
from pytest_twin.identification.effort.sampled import Sampled, sample
from pytest_twin.identification.measured import read_measured
from pytest_twin.identification.regressor import Regressor, SharedMotor
from pytest_twin.realization import Realization
from pytest_twin.signals import NO_SIGNALS
from pytest_twin.twin import DEFAULT_TOPICS

_OF_RECORD = frozenset({
    "effort_bias", "effort_scale", "coupled_armature", "coupled_viscous_friction",
    "coupled_coulomb_friction",
})  # fmt: skip
"""What no model of rigid bodies holds: these come from the record."""


@dataclass(frozen=True, slots=True)
class Rechecked:
    """One joint.

    Attributes:
        relative: |measured - predicted| / |measured|.
        rms: N*m or N.
        slide: whether it is a slide.
    """

    relative: float
    rms: float
    slide: bool


def recheck(
    realization: Realization, record: IdentificationRecord, recordings: Sequence[Path]
) -> dict[str, Rechecked]:
    """Joint -> error of the realization's inverse dynamics along the measured motion.

    Inertia, armature and friction are the realization's own; constant efforts, scales of currents,
    shared motors and errors of encoders are the record's, which no model holds. Motion is
    filtered as it was then.

    Raises:
        RecordingError: no effort, or an identification without measured effort.
        TwinError: a recording that cannot be read.
    """
    if record.filter is None:
        raise RecordingError(
            "this identification had no measured effort",
            path=record.path,
            expected="a golden of kind replay for an identification from commands and positions",
        )
    twin = realization.twin
    signals = NO_SIGNALS if twin is None else twin.signals
    topics = DEFAULT_TOPICS if twin is None else twin.topics
    assert twin is not None
    measured = [
        part
        for path in recordings
        for part in read_measured(path, realization, topics, twin.recordings, signals)
    ]
    joints = measured[0].joints
    encoders = [
        Reading(joint, kind, record.values[f"{joint}.{kind}"], 0.0)
        for joint in joints
        for kind in (BIAS, SCALE)
        if f"{joint}.{kind}" in record.values
    ]
    shared = [
        SharedMotor(j, own.joint, own.ratio)
        for j in joints
        if (own := signals.of(j).shared) is not None
    ]
    unscaled = [j for k, j in enumerate(joints) if measured[0].unscaled[k]]
    regressor = Regressor(realization, joints, shared, unscaled)
    values = regressor.prior.copy()
    for at, column in enumerate(regressor.columns):
        if column.kind in _OF_RECORD:
            values[at] = record.values.get(column.name, 0.0)
        elif column.joint in unscaled and not column.inertial:
            # The drive's parameters of a current are in A.
            values[at] = record.values.get(column.name, 0.0)
    right = without_errors(measured, encoders)
    rows = sample(right, [regressor] * len(right), Filter(*record.filter))
    return {
        joint: found
        for k, joint in enumerate(joints)
        if (found := _error(rows, values, k, regressor.slides[k])) is not None
    }


def _error(
    rows: Sequence[Sampled], values: np.ndarray, joint: int, slide: bool
) -> Rechecked | None:
    effort = np.concatenate([one.effort[:, joint] for one in rows])
    predicted = np.concatenate([one.matrix[:, joint] @ values for one in rows])
    known = np.isfinite(effort)
    if not known.any():
        return None
    off = effort[known] - predicted[known]
    size = float(np.linalg.norm(effort[known]))
    return Rechecked(
        float(np.linalg.norm(off)) / size if size > 0 else 0.0,
        float(np.sqrt(np.mean(off**2))),
        slide,
    )
