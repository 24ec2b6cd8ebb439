"""What a link puts against its gear: its inertia as the rest of the robot lets it move."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray


def link_inertia(
    data: mujoco.MjData,
    positions: FloatArray,
    qpos_index: NDArray[np.int64],
    dof_index: NDArray[np.int64],
) -> FloatArray:
    """(joints,) the least inertia that turns or slides against each joint's motor, kg*m^2 or kg.

    Of the articulated inertia, 1 / (M^-1)_jj, the armature is the motor's (Featherstone, Rigid Body
    Dynamics Algorithms, 2008, ch. 7): a base joint whose arm is free to fold moves little of it.

    Args:
        data: to work with, of a model with armatures.
        positions: (n, joints) rad or m; joints of other columns stand at their zero.
        qpos_index, dof_index: (joints,) of the columns.
    """
    model = data.model
    mass = np.zeros((model.nv, model.nv))
    least = np.full(len(dof_index), np.inf)
    for position in positions:
        data.qpos[qpos_index] = position
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_makeM(model, data)
        mujoco.mj_fullM(model, data, mass)
        articulated = 1.0 / np.diagonal(np.linalg.inv(mass))[dof_index]
        least = np.minimum(least, articulated - model.dof_armature[dof_index])
    return least
