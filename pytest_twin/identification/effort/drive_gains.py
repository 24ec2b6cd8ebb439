"""Drive gains: recorded current per torque, of joints whose torque constant is unknown.

A known payload adds a known torque, so that recordings with and without it determine the gain and
the parameters of the robot together (Gautier, Briot, J. Dynamic Systems, Measurement, and Control
136, 2014). Without a payload the model's own inertia has to stand in for it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.effort_scale import Scale, payload_scales
from pytest_twin.identification.effort.essential_parameters import SIGNIFICANT
from pytest_twin.identification.effort.filtering import choose_filter
from pytest_twin.identification.measured_recordings import MeasuredRecording, MeasuredRecordings
from pytest_twin.identification.regressor import Regressor, SharedMotor
from pytest_twin.realization import Realization

_WIDEST = 0.2
"""Relative half width above which a payload does not determine a gain: the inertia of CAD models,
which stands in for it, is right to 30 %."""


def drive_gains(
    realization: Realization, measured: MeasuredRecordings, shared: Sequence[SharedMotor]
) -> dict[str, Scale]:
    """Return joint -> recorded current per N*m (N), where known payloads determine it.

    Args:
        realization: the nominal model, with the twin that states the payloads.
        measured: recordings of the same joints.
        shared: motors that two joints share.
    """
    joints = measured.fit[0].joints
    unscaled = [j for k, j in enumerate(joints) if any(m.unscaled[k] for m in measured.fit)]
    if not unscaled:
        return {}
    regressor = Regressor(realization, joints, shared)
    scales = payload_scales(realization, measured.fit, regressor, choose_filter(measured.fit))
    return {
        joint: scale
        for joint, scale in scales.items()
        if joint in unscaled
        and scale.value * Z95 >= SIGNIFICANT * scale.half_width
        and scale.half_width <= _WIDEST * scale.value
    }


def as_torques(
    recordings: Sequence[MeasuredRecording], gains: Mapping[str, Scale]
) -> tuple[MeasuredRecording, ...]:
    """Return the recordings with the currents of these joints divided by their gains."""
    found = []
    for one in recordings:
        divisor = np.array([gains[j].value if j in gains else 1.0 for j in one.joints])
        known = np.array([j in gains for j in one.joints])
        found.append(
            replace(
                one,
                effort=one.effort / divisor,
                limit=one.limit / divisor,
                unscaled=one.unscaled & ~known,
            )
        )
    return tuple(found)
