"""Move a floating base along a given course while the joints that it carries move freely.

The free joint gets an armature so large that no other force matters, and a force equal to this
armature times the wanted acceleration. The joints then feel the base's acceleration exactly as if
an ideal drive moved it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray

# Armature relative to the robot's mass, 1 or 1 m^2. Gravity moves such a base by 0.02 mm in 1 min.
_HEAVY = 1e9
_COORDINATES, _DOFS = 7, 6


@dataclass(frozen=True)
class BaseCourse:
    """Course of a base that a simulation follows step by step.

    Attributes:
        qpos: (7,) first position, m, and quaternion w x y z.
        qvel: (6,) first velocity, m/s, and angular velocity in the axes of the base, rad/s.
        force: (steps, 6) forces on the free joint, N and N*m.
    """

    qpos: FloatArray
    qvel: FloatArray
    force: FloatArray


def free_joint_of(model: mujoco.MjModel, joints: Sequence[int]) -> int | None:
    """The free joint of the tree that has these joints; None if there is none, or several trees."""
    roots = {int(model.body_rootid[model.jnt_bodyid[joint]]) for joint in joints}
    if len(roots) != 1:
        return None
    first = int(model.body_jntadr[roots.pop()])
    is_free = first >= 0 and model.jnt_type[first] == mujoco.mjtJoint.mjJNT_FREE
    return first if is_free else None


def heavy_base(model: mujoco.MjModel, joint: int) -> mujoco.MjModel:
    """A copy of the model whose free joint follows its force alone."""
    heavy: mujoco.MjModel = model.__copy__()
    dofs = model.jnt_dofadr[joint] + np.arange(_DOFS)
    heavy.dof_armature[dofs] = armature(model)
    heavy.dof_damping[dofs] = 0.0
    heavy.dof_frictionloss[dofs] = 0.0
    mujoco.mj_setConst(heavy, mujoco.MjData(heavy))
    return heavy


def armature(model: mujoco.MjModel) -> float:
    """Armature of the free joint, kg and kg*m^2."""
    return _HEAVY * max(1.0, float(model.body_subtreemass[0]))


def offset_of(
    model: mujoco.MjModel, joint: int, frame: str
) -> tuple[FloatArray, FloatArray] | None:
    """Position and quaternion of the base in a frame that is rigid with it; None if it is not.

    Args:
        joint: the free joint.
        frame: a body or a site.
    """
    base = int(model.jnt_bodyid[joint])
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, frame)
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, frame)
    if body < 0 and site < 0:
        return None
    carrier = body if body >= 0 else int(model.site_bodyid[site])
    if model.body_weldid[carrier] != model.body_weldid[base]:
        return None
    rotation = (data.xmat[body] if body >= 0 else data.site_xmat[site]).reshape(3, 3)
    origin = data.xpos[body] if body >= 0 else data.site_xpos[site]
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, (rotation.T @ data.xmat[base].reshape(3, 3)).ravel())
    return rotation.T @ (data.xpos[base] - origin), quaternion


def course_along(
    position: FloatArray, quaternion: FloatArray, timestep: float, mass: float
) -> BaseCourse:
    """The forces with which the base is at each pose after each step.

    MuJoCo changes the velocity, and then the position by the new velocity. A velocity is therefore
    the difference of two poses.

    Args:
        position: (steps + 1, 3) m, at the times of the steps.
        quaternion: (steps + 1, 4) w x y z.
        timestep: s.
        mass: :func:`armature` of the model.
    """
    velocity = np.diff(position, axis=0) / timestep
    turning = _rotations(quaternion) / timestep
    both = np.hstack([velocity, turning])
    force = mass * np.diff(both, axis=0, prepend=both[:1]) / timestep
    return BaseCourse(np.concatenate([position[0], quaternion[0]]), both[0], force)


def _rotations(quaternion: FloatArray) -> FloatArray:
    """(n, 3) rotation vectors from each orientation to the next, in the axes of the former."""
    # Half a second of imports that only recorded bases need.
    from scipy.spatial.transform import Rotation

    orientation = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]])
    return np.asarray((orientation[:-1].inv() * orientation[1:]).as_rotvec(), dtype=np.float64)
