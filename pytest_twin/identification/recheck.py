"""Test a realization's prediction of effort on the held-out recordings of an identification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pytest_twin.errors import RecordingError
from pytest_twin.formats.identification_record import IdentificationRecord
from pytest_twin.identification.effort.delay import DELAY, LAG, without_delay
from pytest_twin.identification.effort.drive_gains import as_torques
from pytest_twin.identification.effort.effort_scale import Scale, divide_by_scales, payload_effort
from pytest_twin.identification.effort.filtering import Filter
from pytest_twin.identification.effort.least_squares import linear_problem
from pytest_twin.identification.effort.recording_rows import sample
from pytest_twin.identification.effort.stage_comparison import errors_of
from pytest_twin.identification.measured_recordings import MeasuredRecording, read_measured
from pytest_twin.identification.regressor import Regressor, SharedMotor
from pytest_twin.realization import Realization
from pytest_twin.twin import DEFAULT_TOPICS

_OF_RECORD = frozenset({
    "effort_bias", "effort_scale", "coupled_armature", "coupled_viscous_friction",
    "coupled_coulomb_friction",
})  # fmt: skip
"""Parameters that a rigid-body model cannot contain; they are taken from the record."""


@dataclass(frozen=True, slots=True)
class JointEffortError:
    """Effort error of one joint.

    Attributes:
        relative: |measured - predicted| / |measured|.
        rms: root mean square error, N*m or N.
        slide: whether the joint is prismatic.
    """

    relative: float
    rms: float
    slide: bool


def recheck(
    realization: Realization, record: IdentificationRecord, recordings: Sequence[Path]
) -> dict[str, JointEffortError]:
    """Return joint -> error of the realization's inverse dynamics along the measured motion.

    Inertia, armature, friction and encoders are those of the current twin. Constant efforts, scales
    of currents, shared motors, and delay and scale of the efforts are those of the record, because
    a model cannot contain them. Known payloads are included. The motion is filtered as in the
    identification.

    Raises:
        RecordingError: there is no effort, or the identification had none.
        TwinError: a recording cannot be read.
    """
    if record.filter is None:
        raise RecordingError(
            "this identification had no measured effort",
            path=record.path,
            expected="a golden of kind replay for an identification from commands and positions",
        )
    twin = realization.twin
    topics = DEFAULT_TOPICS if twin is None else twin.topics
    assert twin is not None
    signals = twin.recordings.signals
    measured = [
        part
        for path in recordings
        for part in read_measured(path, realization, topics, twin.recordings, signals)
    ]
    joints = measured[0].joints
    shared = [
        SharedMotor(j, own.joint, own.ratio)
        for j in joints
        if (own := signals.of(j).shared) is not None
    ]
    gains = {joint: Scale(gain, 0.0) for joint, gain in record.drive_gains.items()}
    measured = list(as_torques(measured, gains))
    unscaled = [j for k, j in enumerate(joints) if measured[0].unscaled[k]]
    regressor = Regressor(realization, joints, shared, unscaled)
    values = regressor.prior.copy()
    for at, column in enumerate(regressor.columns):
        # For a current, the drive parameters are in A.
        of_drive = column.joint in unscaled and not column.is_inertial
        if of_drive or column.kind in _OF_RECORD:
            values[at] = record.values.get(column.name, 0.0)
    right = _as_identified(measured, record, unscaled)
    rows = sample(right, [regressor] * len(right), Filter(*record.filter))
    for one, taken in zip(right, rows, strict=True):
        carried = payload_effort(realization, regressor, one, taken)
        if carried is not None:
            taken.effort[...] -= carried
    every = np.arange(len(regressor.columns))
    problem = linear_problem(rows, every, np.zeros((len(joints), len(every)), dtype=bool))
    slides = dict(zip(joints, regressor.slides, strict=True))
    return {
        joint: JointEffortError(error.relative, error.rms, slides[joint])
        for joint, error in errors_of(problem, values, joints).items()
    }


def _as_identified(
    measured: Sequence[MeasuredRecording], record: IdentificationRecord, unscaled: Sequence[str]
) -> tuple[MeasuredRecording, ...]:
    """Remove the record's delay and scale of efforts from the recordings."""
    moved = tuple(measured)
    for name in (DELAY, LAG):
        if name in record.values:
            moved = without_delay(moved, record.values[name], name)
    scales = {
        joint: Scale(record.values[f"{joint}.effort_scale"], 0.0)
        for joint in measured[0].joints
        if joint not in (*unscaled, *record.drive_gains)
        and f"{joint}.effort_scale" in record.values
    }
    return divide_by_scales(moved, scales)
