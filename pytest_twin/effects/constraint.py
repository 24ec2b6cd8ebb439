"""MuJoCo's constraint of dry friction: how it holds.

By default it creeps under load, some 0.03 rad/s for half the level on a small servo. Dry friction
holds: as stiff as the step allows, it creeps 500 times less. A model that sets the constraint
itself is taken at its word.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray

_IMPEDANCE = (0.999, 0.9999, 0.001)
_BY_DEFAULT = mujoco.MjSpec().default.joint


def stiff(timestep: float) -> tuple[FloatArray, FloatArray]:
    """(2,) and (5,) ``solref`` and ``solimp`` of dry friction that holds, for a step in s."""
    impedance = np.array(_BY_DEFAULT.solimp_friction)
    impedance[:3] = _IMPEDANCE
    return np.array([2.0 * timestep, 1.0]), impedance


def _free_to_choose(solref: FloatArray, solimp: FloatArray, timestep: float) -> bool:
    """Whether a friction constraint is MuJoCo's default, or already as stiff as a step in s
    allows: such a one becomes stiffer with a finer step.
    """
    default = _BY_DEFAULT.solref_friction, _BY_DEFAULT.solimp_friction
    return any(
        np.allclose(solref, known[0], rtol=1e-5) and np.allclose(solimp, known[1], rtol=1e-5)
        for known in (default, stiff(timestep))
    )


def hold(model: mujoco.MjModel, dofs: Sequence[int] | NDArray[np.int64], timestep: float) -> None:
    """Let dry friction hold at the model's step, wherever the model says nothing else.

    Args:
        model: changed.
        dofs: where.
        timestep: s, of the model as it came.
    """
    solref, solimp = stiff(float(model.opt.timestep))
    for dof in dofs:
        if _free_to_choose(model.dof_solref[dof], model.dof_solimp[dof], timestep):
            model.dof_solref[dof], model.dof_solimp[dof] = solref, solimp
