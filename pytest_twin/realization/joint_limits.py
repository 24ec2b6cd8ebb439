"""Range and effort limits of joints."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mujoco

    from pytest_twin.realization.model import Realization


def model_range(model: mujoco.MjModel, index: int) -> list[float] | None:
    """(lower, upper) limit of a joint, rad or m; None where it is unlimited."""
    return model.jnt_range[index].tolist() if model.jnt_limited[index] else None


def drivers_of(realization: Realization, joint: str) -> list[str]:
    """Named actuators that drive this joint and no other."""
    driven = realization.structure.actuator_joints
    return [name for name in realization.actuators if driven.get(name) == (joint,)]


def model_effort(realization: Realization, joint: str) -> list[float] | None:
    """Smallest and largest generalized force that actuators can apply to a joint, N*m or N.

    It is the sum of the actuators' force ranges times gear, within the force range of the joint; a
    motor without a force range is limited by its control range. None where nothing limits it.
    """
    model = realization.model
    index = realization.joint_index(joint)
    drivers = _driver_indices(realization, joint)
    lower = upper = 0.0
    for i in drivers:
        gear = float(model.actuator_gear[model.actuator_outadr[i], 0])
        ends = [gear * end for end in _force_range(model, i)]
        lower, upper = lower + min(ends), upper + max(ends)
    if not drivers:
        lower, upper = -math.inf, math.inf
    if model.jnt_actfrclimited[index]:
        own = model.jnt_actfrcrange[index]
        lower, upper = max(lower, float(own[0])), min(upper, float(own[1]))
    return [lower, upper] if math.isfinite(lower) and math.isfinite(upper) else None


def _force_range(model: mujoco.MjModel, actuator: int) -> tuple[float, float]:
    """(smallest, largest) force of an actuator before its gear, N*m or N; infinite if unlimited."""
    import mujoco

    lower, upper = -math.inf, math.inf
    if model.actuator_forcelimited[actuator]:
        lower, upper = (float(end) for end in model.actuator_forcerange[actuator])
    control = int(model.actuator_ctrladr[actuator])
    is_motor = (
        model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE
    )
    if is_motor and model.actuator_ctrllimited[control]:
        gain = float(model.actuator_gainprm[actuator, 0])
        ends = sorted(gain * float(end) for end in model.actuator_ctrlrange[control])
        lower, upper = max(lower, ends[0]), min(upper, ends[1])
    return lower, upper


def _driver_indices(realization: Realization, joint: str) -> list[int]:
    """Indices of actuators that drive this joint and no other, including unnamed ones."""
    from pytest_twin.realization.inputs import JOINT_TRANSMISSIONS

    model = realization.model
    named = [realization.actuator_index(name) for name in drivers_of(realization, joint)]
    nameless = [
        i
        for i in range(model.nactuator)
        if not model.actuator(i).name
        and int(model.actuator_trntype[i]) in JOINT_TRANSMISSIONS
        and int(model.actuator_trnid[i, 0]) == realization.joint_index(joint)
    ]
    return named + nameless
