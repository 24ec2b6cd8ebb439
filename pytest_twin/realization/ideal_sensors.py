"""Compute the readings of ideal sensors on a robot along a motion."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.realization.model import Realization

_NAMES = ("force", "torque", "gyro", "accelerometer")


@dataclass(frozen=True)
class SensorSignals:
    """Ideal sensor signals in the axes of a frame.

    Attributes:
        wrench: (n, 6) force (N) and torque (N*m) about the frame's origin, which the frame's body
            and all bodies beyond it exert on the preceding body. A payload at rest pulls down.
        inertial: (n, 6) angular velocity (rad/s) and specific force (m/s^2).
    """

    wrench: FloatArray
    inertial: FloatArray


def ideal_sensor_signals(
    realization: Realization,
    frame: str,
    joints: tuple[str, ...],
    position: FloatArray,
    velocity: FloatArray,
    acceleration: FloatArray,
) -> SensorSignals:
    """Ideal sensor signals at a site or body along a motion, without contact.

    MuJoCo's ``force`` and ``torque`` sensors give the force that supports the body. The wrench of
    this function has the opposite sign: it is the load on the sensor.

    Args:
        frame: site or body.
        joints: j names; other joints stay at the model's reference.
        position, velocity, acceleration: (n, j) rad, rad/s, rad/s^2 (m, m/s, m/s^2 at a slide).

    Raises:
        SpecError: no such frame or joint.
    """
    kind, _ = realization.frame_index(frame)
    spec = realization.spec.copy()
    for key in list(spec.keys):
        spec.delete(key)
    site = frame
    if kind != mujoco.mjtObj.mjOBJ_SITE:
        site = f"{frame} sensor"
        spec.body(frame).add_site(name=site)
    types = (
        mujoco.mjtSensor.mjSENS_FORCE, mujoco.mjtSensor.mjSENS_TORQUE,
        mujoco.mjtSensor.mjSENS_GYRO, mujoco.mjtSensor.mjSENS_ACCELEROMETER,
    )  # fmt: skip
    for name, sensor in zip(_NAMES, types, strict=True):
        spec.add_sensor(
            name=f"{frame} {name}", type=sensor, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site
        )
    model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data = mujoco.MjData(model)
    places = [int(model.sensor(f"{frame} {name}").adr[0]) for name in _NAMES]
    qpos = [realization.joint_qpos_index(name) for name in joints]
    dof = [realization.joint_dof_index(name) for name in joints]
    found = np.empty((len(position), 12))
    for row in range(len(position)):
        data.qpos[qpos] = position[row]
        data.qvel[dof] = velocity[row]
        data.qacc[dof] = acceleration[row]
        mujoco.mj_inverse(model, data)
        for at, place in enumerate(places):
            found[row, 3 * at : 3 * at + 3] = data.sensordata[place : place + 3]
    return SensorSignals(-found[:, :6], found[:, 6:])


def load_at(
    realization: Realization,
    joint: str,
    joints: tuple[str, ...],
    position: FloatArray,
    velocity: FloatArray,
    acceleration: FloatArray,
) -> FloatArray:
    """(n, 1) load of a hinge (N*m) or slide (N) by the links beyond it, without contact.

    Armature, friction, damping and springs of the joints are excluded. They act between motor and
    link, so that a sensor on the link side of the gear does not measure them.

    Args:
        joint: the joint with the sensor.
        joints: j names; other joints stay at the model's reference.
        position, velocity, acceleration: (n, j) rad, rad/s, rad/s^2 (m, m/s, m/s^2 at a slide).

    Raises:
        SpecError: no such joint.
    """
    model = copy(realization.model)
    for field in (
        model.dof_armature, model.dof_damping, model.dof_dampingpoly, model.dof_frictionloss,
        model.jnt_stiffness, model.jnt_stiffnesspoly,
    ):  # fmt: skip
        field[:] = 0.0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    data = mujoco.MjData(model)
    qpos = [realization.joint_qpos_index(name) for name in joints]
    dof = [realization.joint_dof_index(name) for name in joints]
    own = realization.joint_dof_index(joint)
    found = np.empty((len(position), 1))
    for row in range(len(position)):
        data.qpos[qpos] = position[row]
        data.qvel[dof] = velocity[row]
        data.qacc[dof] = acceleration[row]
        mujoco.mj_inverse(model, data)
        found[row] = data.qfrc_inverse[own]
    return found


def orientations_at(
    realization: Realization, frame: str, joints: tuple[str, ...], position: FloatArray
) -> FloatArray:
    """(n, 3, 3) orientations of a site or body in the world.

    Args:
        frame: site or body.
        joints: j names; other joints stay at the model's reference.
        position: (n, j) rad or m.

    Raises:
        SpecError: no such frame or joint.
    """
    data = mujoco.MjData(realization.model)
    qpos = [realization.joint_qpos_index(name) for name in joints]
    found = np.empty((len(position), 3, 3))
    for row in range(len(position)):
        data.qpos[qpos] = position[row]
        mujoco.mj_kinematics(realization.model, data)
        found[row] = realization.frame_pose(data, frame)[:3, :3]
    return found
