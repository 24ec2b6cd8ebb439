"""Determine the noise of measured efforts and positions: declared, from the model, or assumed."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.excitation.approved_limits import ApprovedLimits, JointLimits
from pytest_twin.realization.model import Realization

ASSUMED_EFFORT = 0.01
"""Assumed noise as a share of the approved effort; predicted deviations are proportional to it."""
ASSUMED_POSITION = 1e-4
"""Assumed noise, rad or m: a 16-bit encoder has 1e-4 rad."""


@dataclass(frozen=True, slots=True)
class SampleNoise:
    """Standard deviations of one sample; samples are independent.

    Attributes:
        effort: (j,) N*m or N.
        position: (j,) rad or m.
        effort_source, position_source: (j,) ``twin.yaml``, ``model`` or ``assumed``.
    """

    effort: FloatArray
    position: FloatArray
    effort_source: tuple[str, ...]
    position_source: tuple[str, ...]


def noise_of(realization: Realization, approved: ApprovedLimits) -> SampleNoise:
    """Return the measurement noise of each joint."""
    efforts = [_effort(realization, joint) for joint in approved.joints]
    positions = [_position(realization, joint) for joint in approved.joints]
    return SampleNoise(
        np.array([value for value, _ in efforts]),
        np.array([value for value, _ in positions]),
        tuple(source for _, source in efforts),
        tuple(source for _, source in positions),
    )


def _effort(realization: Realization, joint: JointLimits) -> tuple[float, str]:
    if joint.effort_noise is not None:
        return float(joint.effort_noise), "twin.yaml"
    stated = _sensor_noise(realization, joint.name, mujoco.mjtSensor.mjSENS_JOINTACTFRC)
    if stated > 0.0:
        return stated, "model"
    return ASSUMED_EFFORT * joint.effort, "assumed"


def _position(realization: Realization, joint: JointLimits) -> tuple[float, str]:
    if joint.position_noise is not None:
        return float(joint.position_noise), "twin.yaml"
    stated = _sensor_noise(realization, joint.name, mujoco.mjtSensor.mjSENS_JOINTPOS)
    return (stated, "model") if stated > 0.0 else (ASSUMED_POSITION, "assumed")


def _sensor_noise(realization: Realization, joint: str, kind: mujoco.mjtSensor) -> float:
    model = realization.model
    own = (model.sensor_type == int(kind)) & (model.sensor_objid == realization.joint_index(joint))
    return float(model.sensor_noise[own].max(initial=0.0))
