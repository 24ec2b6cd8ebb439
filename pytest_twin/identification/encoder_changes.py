"""Changes of an identification to the encoder calibration of the twin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace

from pytest_twin.formats.identification_record import EncoderChange
from pytest_twin.identification.effort.encoders import BIAS, EncoderError
from pytest_twin.identification.effort.identify_effort import EffortResult
from pytest_twin.realization import Realization
from pytest_twin.twin import JointCalibration

_NONE = JointCalibration()


def encoder_changes(realization: Realization, result: EffortResult) -> dict[str, EncoderChange]:
    """Return joint -> encoder before and after, for ``encoders`` of ``identification.json``.

    Joints that earlier records of the twin correct are included, so that a record that supersedes
    them is complete.

    Args:
        realization: nominal model with its twin.
        result: identification; stages that were not accepted change nothing.
    """
    twin = realization.twin
    calibrated = None if twin is None else twin.calibrated
    holding = None if twin is None else twin.calibration
    before = {} if calibrated is None else calibrated.joints
    now = {} if holding is None else holding.joints
    found = {joint: one for joint, one in now.items() if one != before.get(joint, _NONE)}
    for joint in dict.fromkeys(one.joint for one in result.encoders.corrected):
        own = [one for one in result.encoders.corrected if one.joint == joint]
        found[joint] = _correct_calibration(now.get(joint, _NONE), own)
    return {
        joint: EncoderChange(asdict(before.get(joint, _NONE)), asdict(one))
        for joint, one in found.items()
    }


def _correct_calibration(
    now: JointCalibration, readings: Sequence[EncoderError]
) -> JointCalibration:
    """Return the calibration corrected for ``position = (1 + scale) q + bias``."""
    bias = sum(one.value for one in readings if one.kind == BIAS)
    scale = 1.0 + sum(one.value for one in readings if one.kind != BIAS)
    return replace(now, offset=(now.offset - bias) / scale, scale=now.scale / scale)
