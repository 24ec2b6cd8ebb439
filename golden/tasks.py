"""Tasks of the demo arm, as functions of a realization."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

if TYPE_CHECKING:
    from pytest_twin.realization import Realization


def reach(realization: Realization, joints: dict[str, float], seconds: float) -> dict[str, float]:
    """Command a posture and say how the tool arrives.

    Args:
        realization: with an actuator of the same name for every joint.
        joints: posture, rad.
        seconds: to simulate.

    Returns:
        ``arrival_error``: of the tool at the end, m; ``arrival_time``: when it came within 2 mm of
        its end for good, s; ``peak_effort``: greatest torque of any arm drive, N*m.
    """
    model = realization.model
    data = mujoco.MjData(model)
    data.qpos[:] = realization.qpos(joints)
    mujoco.mj_kinematics(model, data)
    goal = realization.frame_pose(data, "tcp")[:3, 3].copy()
    mujoco.mj_resetData(model, data)
    for joint, angle in joints.items():
        data.ctrl[realization.control_index(joint)] = angle
    steps = round(seconds / model.opt.timestep)
    tool = np.empty((steps, 3))
    peak = 0.0
    for k in range(steps):
        mujoco.mj_step(model, data)
        tool[k] = realization.frame_pose(data, "tcp")[:3, 3]
        peak = max(peak, float(np.abs(data.actuator_force[:4]).max()))
    away = np.flatnonzero(np.linalg.norm(tool - tool[-1], axis=1) > 2e-3)
    return {
        "arrival_error": float(np.linalg.norm(tool[-1] - goal)),
        "arrival_time": float((away[-1] + 1 if away.size else 0) * model.opt.timestep),
        "peak_effort": peak,
    }
