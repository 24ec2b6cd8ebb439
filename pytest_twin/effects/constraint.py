"""A stiff dry-friction constraint, so that a joint at rest does not creep.

With MuJoCo's default a joint creeps under load: about 0.03 rad/s at half the friction level on a
small servo. The stiffest constraint that the time step allows creeps 500 times less. A model that
sets the constraint itself keeps it.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray

_IMPEDANCE = (0.999, 0.9999, 0.001)
"""First values of ``solimp``: impedance at zero violation and at the width, and the width. With
MuJoCo's defaults, 0.9 and 0.95, a joint at rest creeps."""
_DEFAULT_JOINT = mujoco.MjSpec().default.joint


def stiff_friction(timestep: float) -> tuple[FloatArray, FloatArray]:
    """(2,) ``solref`` and (5,) ``solimp`` of stiff dry friction for a time step in s."""
    impedance = np.array(_DEFAULT_JOINT.solimp_friction)
    impedance[:3] = _IMPEDANCE
    return np.array([2.0 * timestep, 1.0]), impedance


def _is_default(solref: FloatArray, solimp: FloatArray, timestep: float) -> bool:
    """Whether a friction constraint is MuJoCo's default, or the stiff one of a time step in s.

    The latter becomes stiffer with a finer step.
    """
    default = _DEFAULT_JOINT.solref_friction, _DEFAULT_JOINT.solimp_friction
    return any(
        np.allclose(solref, known[0], rtol=1e-5) and np.allclose(solimp, known[1], rtol=1e-5)
        for known in (default, stiff_friction(timestep))
    )


def follow_timestep(spec: mujoco.MjSpec, timestep: float) -> None:
    """Make stiff dry friction as stiff as the time step of a spec allows.

    Args:
        spec: changed in place.
        timestep: time step for which the friction is stiff now, s.
    """
    before = stiff_friction(timestep)
    after = stiff_friction(float(spec.option.timestep))
    for joint in spec.joints:
        known = joint.solref_friction, joint.solimp_friction
        if all(np.allclose(a, b, rtol=1e-5) for a, b in zip(known, before, strict=True)):
            joint.solref_friction[:], joint.solimp_friction[:] = after


def stiffen_friction(
    model: mujoco.MjModel, dofs: Sequence[int] | NDArray[np.int64], timestep: float
) -> None:
    """Make dry friction stiff where the model does not set the constraint itself.

    Args:
        model: changed in place.
        timestep: time step of the nominal model, s.
    """
    solref, solimp = stiff_friction(float(model.opt.timestep))
    for dof in dofs:
        if _is_default(model.dof_solref[dof], model.dof_solimp[dof], timestep):
            model.dof_solref[dof], model.dof_solimp[dof] = solref, solimp
