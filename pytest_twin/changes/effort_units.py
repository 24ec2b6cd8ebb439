"""Refuse efforts whose unit is not known: a change in N*m or kg would be wrong by its factor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.changes.background import Rows
from pytest_twin.effects.base import si_unit
from pytest_twin.errors import RecordingError
from pytest_twin.identification.effort.filtering import choose_filter
from pytest_twin.identification.effort.input_mistakes import contradicted_factors
from pytest_twin.identification.effort.laws_along import rms_of
from pytest_twin.identification.effort.recording_rows import sample
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.identification.regressor import Regressor
from pytest_twin.realization import Realization
from pytest_twin.signals import NO_SIGNALS

_OTHER_UNIT = 5.0
"""Ratio of later efforts to earlier ones, above which (or below its reciprocal) they have another
unit."""


def without_unscaled(recordings: Sequence[MeasuredRecording]) -> list[MeasuredRecording]:
    """Leave out efforts that are currents of unknown torque constant.

    Raises:
        RecordingError: no effort is left, and there are no commands to simulate.
    """
    unscaled = np.any([one.unscaled for one in recordings], axis=0)
    if not unscaled.any():
        return list(recordings)
    first = recordings[0]
    names = ", ".join(j for j, lost in zip(first.joints, unscaled, strict=True) if lost)
    left = [replace(one, effort=np.where(unscaled, np.nan, one.effort)) for one in recordings]
    for one in left:
        if one.command is None and not np.isfinite(one.effort).any():
            raise RecordingError(
                f"every effort is a current of unknown torque constant: {names}",
                path=one.path,
                where="signals: effort",
                expected="constant: (N*m/A) in twin.yaml, or measured torques",
            )
    note = f"without torque constant, left out: the currents of {names}"
    return [replace(one, notes=(*one.notes, note)) for one in left]


def refuse_contradicted(realization: Realization, before: Sequence[MeasuredRecording]) -> None:
    """Refuse efforts that the model's bodies contradict at most joints, in sign or by a factor.

    Raises:
        RecordingError: with the joint, and what states its unit.
    """
    first = max(before, key=lambda one: float(one.time[-1]))
    twin = realization.twin
    signals = NO_SIGNALS if twin is None else twin.recordings.signals
    regressor = Regressor(realization, first.joints)
    rows = sample([first], [regressor], choose_filter([first]))
    gears = [signals.of(joint).gear for joint in first.joints]
    wrong = [
        mistake
        for mistake in contradicted_factors(rows, regressor, gears)
        if not signals.of(mistake.joint).checked
    ]
    # The factor of a single joint may be a rotor that the model lacks.
    known = int(np.isfinite(first.effort).any(axis=0).sum())
    if 2 * len(wrong) > known:
        mistake = wrong[0]
        raise RecordingError(mistake.what, path=first.path, where="effort", expected=mistake.mend)


def refuse_other_unit(rows: Rows, new: range, size: FloatArray) -> None:
    """Refuse later efforts in another unit: all joints then change by the same factor.

    Args:
        new: indices of the later recordings.
        size: (joints,) RMS effort of the earlier recordings, N*m or N.
    """
    for i in new:
        measured = rms_of([rows.parts[i].recording.effort])
        use = measured > 0.0
        ratios = measured[use] / size[use]
        # A payload multiplies the efforts of light wrists too, but not those of all joints.
        if use.any() and (ratios.min() > _OTHER_UNIT or ratios.max() < 1.0 / _OTHER_UNIT):
            raise RecordingError(
                "its efforts are in another unit than those of the earlier recordings",
                path=rows.parts[i].recording.path,
                where="effort",
                value=f"{np.median(ratios):.3g} times as large",
                expected=f"the same unit, {si_unit('effort', slide=False)}; signals: in twin.yaml "
                "states another one",
            )
