"""Articulated inertia of links: the inertia that a transmission works against."""

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
    """(joints,) smallest articulated inertia of each joint without its armature, kg*m^2 or kg.

    The articulated inertia is 1 / (M^-1)_jj (Featherstone, Rigid Body Dynamics Algorithms, 2008,
    ch. 7). It contains the armature, which belongs to the motor.

    Args:
        data: work space, of a model with armatures.
        positions: (n, joints) rad or m; other joints are at zero.
        qpos_index, dof_index: (joints,) indices of the columns.
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
