"""Move a floating base along a given course while the joints that it carries move freely.

The free joint gets an armature so large that no other force matters, and a force equal to this
armature times the wanted acceleration. The joints then feel the base's acceleration exactly as if
an ideal drive moved it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import RecordingError, SpecError
from pytest_twin.trial.base_motion import BaseMotion

# Armature relative to the robot's mass, 1 or 1 m^2. Gravity moves such a base by 0.02 mm in 1 min.
_HEAVY = 1e9
_COORDINATES, _DOFS = 7, 6
# s. Interval of the differences that are velocities and accelerations of a pose.
_INTERVAL = 1e-3
# Poses at which contacts are looked for.
_MOST_POSES = 400
_Poses = tuple[FloatArray, FloatArray]
"""(n, 3) positions, m, and (n, 4) quaternions w x y z."""
BaseStates = tuple[FloatArray, FloatArray, FloatArray]
"""(n, 7) coordinates, (n, 6) velocities and (n, 6) accelerations of a free joint, as of MuJoCo:
linear ones in the axes of the world, m and s, angular ones in those of the base, rad and s."""


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


@dataclass(frozen=True)
class DrivenBase:
    """A floating base whose recorded pose is given.

    Attributes:
        motion: recorded motion of a frame that is rigid with the base.
        joint: its free joint.
        mass: armature of the free joint, kg and kg*m^2.
        offset: position, m, and quaternion w x y z of the base in the recorded frame; None if they
            are the same.
    """

    motion: BaseMotion
    joint: int
    qpos: slice
    dof: slice
    mass: float
    offset: tuple[FloatArray, FloatArray] | None = None

    def course(self, start: float, timestep: float, steps: int) -> BaseCourse:
        """The forces of a simulation from ``start``, s from the first state.

        MuJoCo changes the velocity, and then the position by the new velocity. A velocity is
        therefore the difference of two poses.
        """
        times = start + timestep * np.arange(steps + 1)
        position, quaternion = self._poses(np.asarray(times, dtype=np.float64))
        velocity = _velocity(
            (position[:-1], quaternion[:-1]), (position[1:], quaternion[1:]), timestep
        )
        force = self.mass * np.diff(velocity, axis=0, prepend=velocity[:1]) / timestep
        return BaseCourse(np.concatenate([position[0], quaternion[0]]), velocity[0], force)

    def states(self, time: FloatArray) -> BaseStates:
        """Motion of the base at (n,) times, s from the first state."""
        before, here, after = (
            self._poses(time + shift) for shift in (-_INTERVAL, 0.0, _INTERVAL)
        )  # fmt: skip
        arriving, leaving = _velocity(before, here, _INTERVAL), _velocity(here, after, _INTERVAL)
        acceleration = (leaving - arriving) / _INTERVAL
        return np.hstack(here), 0.5 * (arriving + leaving), acceleration

    def place(self, data: mujoco.MjData, time: float) -> None:
        """Set position, velocity and acceleration of the base at a time, s from the first state."""
        (data.qpos[self.qpos],), (data.qvel[self.dof],), (data.qacc[self.dof],) = self.states(
            np.array([time])
        )

    def _poses(self, time: FloatArray) -> _Poses:
        recorded = self.motion.at(time)
        return recorded if self.offset is None else _moved(*recorded, *self.offset)


def drive_base(
    model: mujoco.MjModel, joints: Sequence[int], motion: BaseMotion, source: Path | None
) -> tuple[mujoco.MjModel, DrivenBase, tuple[str, ...]]:
    """Return the model whose base follows a motion, the base, and notes.

    Args:
        joints: recorded joints.
        source: path of the model, for errors.

    Raises:
        SpecError: the recorded joints are not carried by one free joint.
    """
    joint = free_joint_of(model, joints)
    if joint is None:
        raise SpecError(
            "the recorded joints are not carried by one floating base", path=source,
            expected="one free joint at the base of the robot, whose pose is recorded",
        )  # fmt: skip
    base_name = model.body(model.jnt_bodyid[joint]).name
    offset = None
    notes: tuple[str, ...] = ()
    if motion.frame and motion.frame != base_name:
        offset = offset_of(model, joint, motion.frame)
        if offset is None:
            notes = (
                f"{motion.source}: the model has no body or site {motion.frame!r} that is "
                f"rigid with its base: its pose is taken as that of {base_name!r}",
            )
    heavy = heavy_base(model, joint)
    qpos, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    base = DrivenBase(
        motion, joint, slice(qpos, qpos + _COORDINATES), slice(dof, dof + _DOFS),
        armature(heavy), offset,
    )  # fmt: skip
    return heavy, base, notes


def refuse_contact(
    model: mujoco.MjModel,
    base: DrivenBase,
    joints: Sequence[int],
    time: FloatArray,
    position: FloatArray,
    path: Path,
) -> None:
    """Check that the robot touches nothing along its recorded motion.

    The forces of a contact depend on poses far below their accuracy, and move the joints.

    Args:
        time: (n,) s from the first state.
        position: (n, joints) rad or m.
        path: path of the recording, for errors.

    Raises:
        RecordingError: it touches something.
    """
    data = mujoco.MjData(model)
    tree = model.body_rootid == model.body_rootid[model.jnt_bodyid[base.joint]]
    every = max(1, len(time) // _MOST_POSES)
    coordinates, _, _ = base.states(time[::every])
    for seconds, pose, joint_positions in zip(
        time[::every], coordinates, position[::every], strict=True
    ):
        data.qpos[base.qpos] = pose
        data.qpos[model.jnt_qposadr[list(joints)]] = joint_positions
        mujoco.mj_fwdPosition(model, data)
        for contact in data.contact[: data.ncon]:
            bodies = model.geom_bodyid[contact.geom]
            if tree[bodies].sum() == 1 and contact.dist < 0.0:
                first, second = (model.body(int(body)).name or "world" for body in bodies)
                raise RecordingError(
                    "effects are not estimated while the robot of a recorded base pose touches "
                    "something, because its forces are not recorded",
                    path=path, where=f"{first!r} and {second!r} at {seconds:.4g} s",
                    value=f"{-1e3 * contact.dist:.3g}", unit="mm deep",
                    expected="a motion in the air, or a robot that a rig held: --base fixed",
                )  # fmt: skip


def _moved(
    position: FloatArray, quaternion: FloatArray, offset: FloatArray, turn: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Poses of a frame at a constant offset (m) and orientation (w x y z) in a moving frame."""
    moved, turned = np.empty_like(position), np.empty_like(quaternion)
    for row, (at, orientation) in enumerate(zip(position, quaternion, strict=True)):
        mujoco.mju_rotVecQuat(moved[row], offset, orientation)
        moved[row] += at
        mujoco.mju_mulQuat(turned[row], orientation, turn)
    return moved, turned


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


def _velocity(first: _Poses, second: _Poses, interval: float) -> FloatArray:
    """(n, 6) velocities, m/s and rad/s in the axes of the base, from n poses to n others."""
    # Half a second of imports that only recorded bases need.
    from scipy.spatial.transform import Rotation

    before, after = (Rotation.from_quat(q[:, [1, 2, 3, 0]]) for _, q in (first, second))
    turn = np.asarray((before.inv() * after).as_rotvec(), dtype=np.float64)
    return np.hstack([second[0] - first[0], turn]) / interval
