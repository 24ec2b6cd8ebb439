"""Residuals and Jacobian of the equality constraints of a MuJoCo model in a pose."""

from __future__ import annotations

import copy

import mujoco

from pytest_twin.arrays import FloatArray


class EqualityRows:
    """Active equality constraints: of joints, sites, bodies and tendons.

    Args:
        model: the model; it is not changed.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = copy.copy(model)
        self._model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        self._data = mujoco.MjData(self._model)

    def at(self, qpos: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (rows,) residuals, m or rad, and their (rows, nv) Jacobian at a pose."""
        model, data = self._model, self._data
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        # Without their Jacobians, constraints of tendons are left out without a word.
        mujoco.mj_tendon(model, data)
        mujoco.mj_makeConstraint(model, data)
        equality = data.efc_type[: data.nefc] == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        # MuJoCo counts empty rows but does not fill them, so the array may be longer.
        jacobian = data.efc_J[: data.nefc * model.nv].reshape(data.nefc, model.nv)
        return data.efc_pos[: data.nefc][equality], jacobian[equality]
