"""What a model states of a joint's range and of the effort that its drives may apply."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mujoco

    from pytest_twin.realization.model import Realization


def model_range(model: mujoco.MjModel, index: int) -> list[float] | None:
    """Stops of a joint, rad or m; None where it has none."""
    return model.jnt_range[index].tolist() if model.jnt_limited[index] else None


def drivers_of(realization: Realization, joint: str) -> list[str]:
    """Actuators whose transmission is the joint alone."""
    driven = realization.structure.actuator_joints
    return [name for name in realization.actuators if driven.get(name) == (joint,)]


def model_effort(realization: Realization, joint: str) -> list[float] | None:
    """Least and greatest generalized force (N*m or N) that the model lets actuators apply.

    Force ranges of the actuators through their gears, within the joint's own; None where
    neither is limited.
    """
    model = realization.model
    index = realization.joint_index(joint)
    drivers = _driver_indices(realization, joint)
    lower = upper = 0.0
    for i in drivers:
        gear = float(model.actuator_gear[model.actuator_outadr[i], 0])
        ends = [-math.inf, math.inf]
        if model.actuator_forcelimited[i]:
            ends = [gear * float(end) for end in model.actuator_forcerange[i]]
        lower, upper = lower + min(ends), upper + max(ends)
    if not drivers:
        lower, upper = -math.inf, math.inf
    if model.jnt_actfrclimited[index]:
        own = model.jnt_actfrcrange[index]
        lower, upper = max(lower, float(own[0])), min(upper, float(own[1]))
    return [lower, upper] if math.isfinite(lower) and math.isfinite(upper) else None


def _driver_indices(realization: Realization, joint: str) -> list[int]:
    """Actuators whose transmission is the joint alone, those without a name too."""
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
