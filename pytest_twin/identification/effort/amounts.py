"""Leave out efforts that are amounts without a sign, and keep torques of one sign."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pytest_twin.identification.effort.filtering import choose_filter
from pytest_twin.identification.effort.input_mistakes import amount_ratio
from pytest_twin.identification.effort.recording_rows import sample
from pytest_twin.identification.measured_recordings import (
    AN_AMOUNT,
    MeasuredRecording,
    MeasuredRecordings,
    may_be_an_amount,
)
from pytest_twin.identification.regressor import Regressor
from pytest_twin.realization import Realization

_WORSE = 1.1
"""An effort of one sign is a torque, not an amount, if the residual grows by more than this factor
when the effort gets the sign that the model predicts."""


def without_amounts(realization: Realization, measured: MeasuredRecordings) -> MeasuredRecordings:
    """Return the recordings without the efforts that are amounts.

    An effort that is never negative and often zero is an amount, unless the model explains it as a
    torque: the weight that it carries has one sign, or the sign of the model's effort makes the fit
    worse.
    """
    joints = measured.fit[0].joints
    every = (*measured.fit, *measured.held_out)
    suspects = [
        k
        for k in range(len(joints))
        if any(may_be_an_amount(one.effort[:, k]) for one in every)
        and not any((one.effort[:, k] < 0.0).any() for one in every)
    ]
    if not suspects:
        return measured
    unscaled = [j for k, j in enumerate(joints) if any(one.unscaled[k] for one in measured.fit)]
    regressor = Regressor(realization, joints, (), unscaled)
    rows = sample(measured.fit, [regressor] * len(measured.fit), choose_filter(measured.fit))
    lost = []
    for k in suspects:
        ratio = amount_ratio(rows, regressor, k)
        if ratio is None or ratio <= _WORSE:
            lost.append(k)
    notes = tuple(f"{joints[k]}: {AN_AMOUNT}" for k in lost)

    def left(one: MeasuredRecording) -> MeasuredRecording:
        effort = one.effort.copy()
        effort[:, lost] = np.nan
        return replace(one, effort=effort, notes=(*notes, *one.notes))

    return replace(
        measured,
        fit=tuple(left(one) for one in measured.fit),
        held_out=tuple(left(one) for one in measured.held_out),
    )
