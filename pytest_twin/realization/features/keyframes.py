"""Content of keyframe parts."""

from __future__ import annotations

from typing import Any

import numpy as np

from pytest_twin.realization.engine import model_field
from pytest_twin.realization.features.canonical import (
    as_list,
    one_or_listed,
)
from pytest_twin.realization.features.elements import DOFS, QPOS, Elements


def keyframe(elements: Elements, key: int) -> dict[str, Any]:
    """State and controls of a keyframe, by the names of joints and actuators."""
    model = elements.model
    positions, velocities = {}, {}
    for joint in range(model.njnt):
        kind, name = elements.joint_type[joint], elements.joint[joint]
        at, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        positions[name] = one_or_listed(np.round(model.key_qpos[key, at : at + QPOS[kind]], 12))
        velocities[name] = one_or_listed(model.key_qvel[key, dof : dof + DOFS[kind]])
    controls, activations = {}, {}
    for actuator in range(model.nactuator):
        at, count = model.actuator_ctrladr[actuator], model.actuator_ctrlnum[actuator]
        controls[elements.actuator[actuator]] = one_or_listed(model.key_ctrl[key, at : at + count])
        at, count = model.actuator_actadr[actuator], model.actuator_actnum[actuator]
        if at >= 0:
            activations[elements.actuator[actuator]] = one_or_listed(
                model.key_act[key, at : at + count]
            )
    return {
        "time [s]": float(model.key_time[key]),
        "positions": positions,
        "velocities": velocities,
        "controls": controls,
        "activations": activations,
        "mocap positions": as_list(model.key_mpos[key]),
        "mocap quaternions": as_list(model.key_mquat[key]),
        "plastic state": as_list(model_field(model, "key_plastic")[key]),
    }
