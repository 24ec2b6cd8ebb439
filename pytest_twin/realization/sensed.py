"""What ideal sensors at a frame of a robot read along a motion."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.realization.model import Realization

_NAMES = ("force", "torque", "gyro", "accelerometer")


@dataclass(frozen=True)
class Sensed:
    """True signals in the axes of a frame.

    Attributes:
        wrench: (n, 6) force (N) and torque (N*m) of the frame's body and all beyond it on what
            carries them, about the frame's origin: a payload at rest pulls down.
        inertial: (n, 6) angular velocity (rad/s) and specific force (m/s^2).
    """

    wrench: FloatArray
    inertial: FloatArray


def sensed_at(
    realization: Realization,
    frame: str,
    joints: tuple[str, ...],
    position: FloatArray,
    velocity: FloatArray,
    acceleration: FloatArray,
) -> Sensed:
    """Ideal readings at a site or body along a motion, without contact.

    MuJoCo's ``force`` and ``torque`` sensors give what carries the body; the wrench here is its
    opposite, the load on the sensor.

    Args:
        frame: site or body.
        joints: j names; others stay at the model's reference.
        position, velocity, acceleration: (n, j).

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
    return Sensed(-found[:, :6], found[:, 6:])
