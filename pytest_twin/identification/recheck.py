"""Test a realization's prediction of effort on the held-out recordings of an identification."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.sensing import EffortBias, EffortScale
from pytest_twin.errors import RecordingError
from pytest_twin.formats.identification_record import IdentificationRecord
from pytest_twin.identification.effort.delay import DELAY, LAG, without_delay
from pytest_twin.identification.effort.drive_gains import as_torques
from pytest_twin.identification.effort.effort_scale import Scale, divide_by_scales, payload_effort
from pytest_twin.identification.effort.filtering import Filter
from pytest_twin.identification.effort.least_squares import linear_problem
from pytest_twin.identification.effort.recording_rows import sample
from pytest_twin.identification.effort.stage_comparison import EffortError, errors_of
from pytest_twin.identification.known_effects import known_efforts
from pytest_twin.identification.measured_recordings import MeasuredRecording, read_measured
from pytest_twin.identification.regressor import Regressor, SharedMotor
from pytest_twin.realization import Realization
from pytest_twin.recording_options import NO_OPTIONS, RecordingOptions
from pytest_twin.twin import DEFAULT_TOPICS

_OF_RECORD = frozenset({
    EffortBias.id, EffortScale.id, "coupled_armature", "coupled_viscous_friction",
    "coupled_coulomb_friction",
})  # fmt: skip
"""Parameters that a rigid-body model cannot contain; they are taken from the record."""
_OF_READINGS = frozenset({EffortBias.id, EffortScale.id})
"""Those of them that ``effects.json`` of a fitted model contains."""


@dataclass(frozen=True)
class EffortRecord:
    """What an identification holds of efforts beside its model.

    Attributes:
        values: parameter -> value.
        drive_gains: joint -> recorded current per torque.
        rest: (joints,) speeds below which a joint is at rest; None for those of the recordings.
    """

    values: Mapping[str, float]
    drive_gains: Mapping[str, float]
    filter: Filter
    rest: FloatArray | None = None


def recheck(
    realization: Realization, record: IdentificationRecord, recordings: Sequence[Path]
) -> dict[str, EffortError]:
    """Return joint -> error of the realization's inverse dynamics along the measured motion.

    Inertia, armature, friction and encoders are those of the current twin. Constant efforts, scales
    of currents, shared motors, and delay and scale of the efforts are those of the record, as far
    as the realization does not contain them.

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
    assert twin is not None
    return effort_errors(
        realization, recordings,
        EffortRecord(record.values, record.drive_gains, Filter(*record.filter)),
        twin.topics, twin.recordings,
    )  # fmt: skip


def effort_errors(
    realization: Realization,
    recordings: Sequence[Path],
    record: EffortRecord,
    topics: Mapping[str, str] = DEFAULT_TOPICS,
    options: RecordingOptions = NO_OPTIONS,
) -> dict[str, EffortError]:
    """Return joint -> error of a realization's inverse dynamics along the measured motion.

    The motion is filtered as in the identification. Known payloads are included.

    Args:
        recordings: recordings with efforts.
        record: the identification; its values are used as far as the model cannot contain them.
        topics, options: settings for reading the recordings.

    Raises:
        RecordingError: there is no effort.
        TwinError: a recording cannot be read.
    """
    signals = options.signals
    measured = [
        part
        for path in recordings
        for part in read_measured(path, realization, topics, options, signals)
    ]
    joints = measured[0].joints
    shared = [
        SharedMotor(j, own.joint, own.ratio)
        for j in joints
        if (own := signals.of(j).shared) is not None
    ]
    contained = {
        f"{one.joint}.{one.effect}"
        for one in known_efforts(realization, joints).effects
        if one.effect in _OF_READINGS
    }
    given = {name: value for name, value in record.values.items() if name not in contained}
    gains = {
        joint: Scale(gain, 0.0)
        for joint, gain in record.drive_gains.items()
        if f"{joint}.{EffortScale.id}" not in contained
    }
    measured = list(as_torques(measured, gains))
    unscaled = [j for k, j in enumerate(joints) if measured[0].unscaled[k]]
    regressor = Regressor(realization, joints, shared, unscaled)
    values = regressor.prior.copy()
    for at, column in enumerate(regressor.columns):
        # For a current, the drive parameters are in A.
        of_drive = column.joint in unscaled and not column.is_inertial
        if of_drive or column.kind in _OF_RECORD:
            values[at] = given.get(column.name, 0.0)
    right = _as_identified(measured, given, [*unscaled, *record.drive_gains])
    rows = sample(right, [regressor] * len(right), record.filter, rest=record.rest)
    for one, taken in zip(right, rows, strict=True):
        carried = payload_effort(realization, regressor, one, taken)
        if carried is not None:
            taken.effort[...] -= carried
    every = np.arange(len(regressor.columns))
    problem = linear_problem(rows, every, np.zeros((len(joints), len(every)), dtype=bool))
    return errors_of(problem, values, joints)


def _as_identified(
    measured: Sequence[MeasuredRecording], record: Mapping[str, float], currents: Sequence[str]
) -> tuple[MeasuredRecording, ...]:
    """Remove the record's delay and scale of efforts from the recordings."""
    moved = tuple(measured)
    for name in (DELAY, LAG):
        if name in record:
            moved = without_delay(moved, record[name], name)
    scales = {
        joint: Scale(record[f"{joint}.{EffortScale.id}"], 0.0)
        for joint in measured[0].joints
        if joint not in currents and f"{joint}.{EffortScale.id}" in record
    }
    return divide_by_scales(moved, scales)
