"""Add frames, sensors and transmissions of a URDF to its MuJoCo spec."""

from __future__ import annotations

import mujoco
import numpy as np

from pytest_twin.realization.urdf import MOVING, Robot
from pytest_twin.realization.urdf_extras import Extras, Sensor

_SENSORS = {
    "imu": ("mjSENS_ACCELEROMETER", "mjSENS_GYRO"),
    "force_torque": ("mjSENS_FORCE", "mjSENS_TORQUE"),
    "magnetometer": ("mjSENS_MAGNETOMETER",),
}


def add(spec: mujoco.MjSpec, robot: Robot, extras: Extras) -> None:
    """Add sites for frames and sensors, and an actuator for each joint with a transmission.

    A frame is a link without mass and shapes. Sensors that MuJoCo supports are added at their site;
    for other sensors only the site is added. An actuator without an effort limit is an unlimited
    motor whose force acts on the joint side of the gear.
    """
    taken = set()
    for name, link in robot.links.items():
        bare = link.mass == 0 and not link.node.all("collision") and not link.node.all("visual")
        if bare and name != robot.root:
            spec.body(name).add_site(name=name, group=4, size=[0.005] * 3)
            taken.add(name)
    for sensor in extras.sensors:
        _sensor(spec, sensor, taken)
    driven = {actuator.target for actuator in spec.actuators}
    for transmission in extras.transmissions:
        joint = robot.joints.get(transmission.joint)
        if joint is None or joint.name in driven or joint.mimic is not None:
            continue
        if joint.type in MOVING[:3]:
            driven.add(joint.name)
            actuator = spec.add_actuator(
                name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
            )
            actuator.set_to_motor()


def _sensor(spec: mujoco.MjSpec, sensor: Sensor, taken: set[str]) -> None:
    name = sensor.name
    while name in taken:
        name += "_sensor"
    taken.add(name)
    body = spec.worldbody if sensor.link == "world" else spec.body(sensor.link)
    site = body.add_site(name=name, pos=sensor.pose[:3, 3], group=4, size=[0.005] * 3)
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(sensor.pose[:3, :3]).ravel())
    site.quat = quaternion
    for kind in _SENSORS.get(sensor.type, ()):
        spec.add_sensor(
            name=f"{name}_{kind.removeprefix('mjSENS_').lower()}",
            type=getattr(mujoco.mjtSensor, kind),
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            objname=name,
        )
