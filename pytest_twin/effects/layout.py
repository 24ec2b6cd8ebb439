"""Indices of joints and drives in a model's arrays, and reference lengths of links."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.segment import Segment
from pytest_twin.realization.inputs import CommandInput, command_input, joint_inputs
from pytest_twin.trial import CommandMode

_MIN_AXIS_DISTANCE = 1e-4
"""Distance of a centre of mass from the joint's axis below which it counts as on the axis, m."""
_FLANGE_SHARE = 0.03
"""A last link whose centre of mass is closer to its joint than this share of the arm's length is a
flange: its size says nothing about its payload."""
_FLANGE_TOOL_LENGTH, _MIN_TOOL_LENGTH, _MIN_FLANGE_LOAD = 0.15, 0.05, 0.02
"""Reference length of a payload on a flange and on any last link, as shares of the arm's length;
smallest reference mass on a flange, as a share of the arm's mass."""

Index = slice | NDArray[np.int64]
"""Places along an axis of an array."""


class Layout:
    """Indices of hinges, slides and commanded drives, and reference scales of joints and links.

    Attributes:
        joints: names of the joints, in the order of the segments' columns.
        joint_ids, qpos_index, dof_index, body_index: (joints,) indices in the model.
        slides: (joints,) whether the joint is a slide.
        servo: (joints,) command mode: ``position``, ``velocity``, ``effort`` or ``none``.
        control, actuator: (joints,) indices of the control and of the actuator; -1 without one.
        scale: (joints,) ratio of control to command.
        gear: (joints,) ratio of the effort at the joint to the force of the actuator.
        driven: (driven,) indices of the joints with an actuator.
        is_unactuated: (joints,) whether effort is commanded and the joint has no actuator.
        directions: (joints, 3) unit vectors from the joint to its link's centre of mass, in the
            frame of the link.
        link_length: (joints,) distance from the joint to its link's centre of mass, m.
        radial, tangential: (joints, 3) unit vectors from the joint's axis to that centre, and in
            its direction of motion, in the frame of the link.
        gyration: (joints,) radius of gyration of the link about the joint, m.
        tool_length, tool_mass: reference length in m and mass in kg of a payload: those of the last
            link, with a smallest share of the arm's length; for a flange shares of the arm's.
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
        self.is_unactuated = (self.servo == "effort") & (self.actuator < 0)
        self.directions = self._link_directions(model)
        self.radial, self.tangential = self._radial_directions(model)
        mass = np.maximum(model.body_mass[self.body_index], 1e-6)
        own = model.body_inertia[self.body_index].mean(axis=1) / mass
        self._find_tool(model)
        self.gyration = np.sqrt(self.link_length**2 + own)

    @classmethod
    def of_model(cls, model: mujoco.MjModel, joints: Sequence[str]) -> Layout:
        """The layout without recordings: a joint with one control input has its drive and mode."""
        layout = cls(model, (), joints)
        for j, joint in enumerate(joints):
            inputs = joint_inputs(model, joint)
            if len(inputs) == 1:
                layout._set_drive(model, j, inputs[0].mode, inputs[0])
        layout.driven = np.flatnonzero(layout.actuator >= 0)
        return layout

    def _find_tool(self, model: mujoco.MjModel) -> None:
        """Set the reference length, mass and direction of a payload on the last link."""
        body = self.body_index[-1]
        ways = np.linalg.norm(model.body_pos[self.body_index[1:]], axis=1)
        arm, own = float(ways.sum()), float(self.link_length[-1])
        self.tool_length = max(own, _MIN_TOOL_LENGTH * arm)
        self.tool_mass = float(model.body_mass[body])
        self._load_directions = self.directions.copy()
        if own >= _FLANGE_SHARE * arm:
            return
        moved = float(model.body_mass[self.body_index].sum())
        self.tool_length = _FLANGE_TOOL_LENGTH * arm
        self.tool_mass = max(self.tool_mass, _MIN_FLANGE_LOAD * moved)
        axis = model.jnt_axis[self.joint_ids[-1]]
        center = model.body_ipos[body] - model.jnt_pos[self.joint_ids[-1]]
        height = float(axis @ center)
        if np.linalg.norm(center - height * axis) <= abs(height):
            # A payload on a flange extends along the flange's axis, away from the arm.
            back, outwards = np.zeros(4), np.zeros(3)
            mujoco.mju_negQuat(back, model.body_quat[body])
            mujoco.mju_rotVecQuat(outwards, model.body_pos[body], back)
            self._load_directions[-1] = axis if axis @ outwards >= 0.0 else -axis

    def _find_drives(self, model: mujoco.MjModel, segments: Sequence[Segment]) -> None:
        """Set command mode, control, actuator, scale and gear of each joint."""
        count = len(self.joints)
        self.control = np.full(count, -1)
        self.actuator = np.full(count, -1)
        self.scale = np.ones(count)
        self.gear = np.ones(count)
        self.servo = np.full(count, "none", dtype="<U8")
        for j, joint in enumerate(self.joints):
            modes = {s.mode_of(j) for s in segments if np.isfinite(s.command[:, j]).all()}
            if not modes:
                continue
            mode = modes.pop()
            target = command_input(model, joint, mode)
            self._set_drive(model, j, mode, target)

    def _set_drive(
        self, model: mujoco.MjModel, joint: int, mode: CommandMode, target: CommandInput | None
    ) -> None:
        self.servo[joint] = mode
        if target is not None:
            self.control[joint], self.actuator[joint] = target.control, target.actuator
            self.scale[joint] = target.scale
            self.gear[joint] = model.actuator_gear[model.actuator_outadr[target.actuator], 0]

    def _link_directions(self, model: mujoco.MjModel) -> FloatArray:
        """(joints, 3) directions to the centres of mass; sets :attr:`link_length`."""
        offset = model.body_ipos[self.body_index] - model.jnt_pos[self.joint_ids]
        length = np.linalg.norm(offset, axis=1, keepdims=True)
        self.link_length = np.maximum(length[:, 0], 1e-3)
        return np.where(length > 1e-6, offset / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])

    def to_link_frame(self, place: FloatArray, joint: NDArray[np.int64]) -> FloatArray:
        """Positions (n, 3) in link frames from positions in own axes, both in m.

        The own axes point along the link (for a flange: along the joint's axis), in the joint's
        direction of motion, and perpendicular to both.
        """
        found: FloatArray = np.einsum("nk,nki->ni", place, self.payload_axes(joint))
        return found

    def payload_axes(self, joint: NDArray[np.int64]) -> FloatArray:
        """(n, 3, 3) own axes of :meth:`to_link_frame` as rows, in the frames of the links."""
        axis_of_load, turning = self._load_directions[joint], self.tangential[joint]
        return np.stack([axis_of_load, turning, np.cross(axis_of_load, turning)], axis=1)

    def center_shift(
        self, radial: FloatArray, tangential: FloatArray, joint: NDArray[np.int64]
    ) -> FloatArray:
        """(..., 3) shift in link frames from (...,) radial and tangential shifts, all in m."""
        moved: FloatArray = radial[..., None] * self.radial[joint]
        return moved + tangential[..., None] * self.tangential[joint]

    def _radial_directions(self, model: mujoco.MjModel) -> tuple[FloatArray, FloatArray]:
        """Radial and tangential unit vectors, (joints, 3) each, in the frames of the links.

        If the centre of mass is on the joint's axis, the radial vector is the frame axis with the
        largest angle to it.
        """
        axis = model.jnt_axis[self.joint_ids]
        aside = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
        offset = self.link_length[:, None] * self.directions
        for way in (offset, aside):
            way -= np.einsum("ji,ji->j", way, axis)[:, None] * axis
        on_axis = np.linalg.norm(offset, axis=1, keepdims=True) < _MIN_AXIS_DISTANCE
        radial = np.where(on_axis, aside, offset)
        radial /= np.linalg.norm(radial, axis=1, keepdims=True)
        return radial, np.cross(axis, radial)


def as_slice(index: NDArray[np.int64]) -> Index:
    """The index as a slice if its elements are adjacent, because a slice needs no copy."""
    if len(index) and (np.diff(index) == 1).all():
        return slice(int(index[0]), int(index[-1]) + 1)
    return index
