"""Where joints and the drives behind them lie in a model's arrays."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from pytest_twin.effects.base import FloatArray
from pytest_twin.effects.segment import Segment
from pytest_twin.realization.inputs import command_input


class Layout:
    """Indices of hinges and slides, of the drives that segments command, and what those scale by.

    Attributes:
        joints: names, in the order of the segments' columns.
        joint_ids, qpos_index, dof_index, body_index: (joints,).
        slides: (joints,) whether it slides.
        servo: (joints,) what is commanded: ``position``, ``velocity``, ``effort`` or ``none``.
        control, actuator: (joints,) of its command and its drive, -1 without one.
        scale: (joints,) control over command.
        gear: (joints,) effort at the joint over force of the actuator.
        driven: (driven,) joints that an actuator drives.
        bare: (joints,) whether effort is commanded and no actuator gives it.
        directions: (joints, 3) unit vectors from each joint to its link's centre of mass, frame of
            the link.
        link_length: (joints,) m, of those.
    """

    def __init__(
        self, model: mujoco.MjModel, segments: Sequence[Segment], joints: Sequence[str]
    ) -> None:
        self.joints = tuple(joints)
        ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, j) for j in joints]
        self.joint_ids = np.array(ids)
        self.qpos_index = model.jnt_qposadr[self.joint_ids]
        self.dof_index = model.jnt_dofadr[self.joint_ids]
        self.body_index = model.jnt_bodyid[self.joint_ids]
        self.slides = model.jnt_type[self.joint_ids] == int(mujoco.mjtJoint.mjJNT_SLIDE)
        self._find_drives(model, segments)
        self.driven = np.flatnonzero(self.actuator >= 0)
        self.bare = (self.servo == "effort") & (self.actuator < 0)
        self.directions = self._link_directions(model)

    def _find_drives(self, model: mujoco.MjModel, segments: Sequence[Segment]) -> None:
        count = len(self.joints)
        self.control = np.full(count, -1)
        self.actuator = np.full(count, -1)
        self.scale = np.ones(count)
        self.gear = np.ones(count)
        self.servo = np.full(count, "none", dtype="<U8")
        for j, joint in enumerate(self.joints):
            modes = {s.mode for s in segments if np.isfinite(s.command[:, j]).all()}
            if not modes:
                continue
            mode = modes.pop()
            target = command_input(model, joint, mode)
            self.servo[j] = mode
            if target is not None:
                self.control[j], self.actuator[j] = target.control, target.actuator
                self.scale[j] = target.scale
                self.gear[j] = model.actuator_gear[model.actuator_outadr[target.actuator], 0]

    def _link_directions(self, model: mujoco.MjModel) -> FloatArray:
        offset = model.body_ipos[self.body_index] - model.jnt_pos[self.joint_ids]
        length = np.linalg.norm(offset, axis=1, keepdims=True)
        self.link_length = np.maximum(length[:, 0], 1e-3)
        return np.where(length > 1e-6, offset / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])
