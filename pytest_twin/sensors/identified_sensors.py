"""Sensors from the record of an identification."""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.formats.sensor_record import FORCE_TORQUE, IMU, JOINT_TORQUE, SensorFields
from pytest_twin.sensors import force_torque, imu
from pytest_twin.sensors.force_torque import ForceTorqueSensor
from pytest_twin.sensors.imu import ImuSensor
from pytest_twin.sensors.joint_torque import JointTorqueSensor

AXES = {FORCE_TORQUE: force_torque.AXES, IMU: imu.AXES, JOINT_TORQUE: ("torque",)}
"""Kind -> its channels. The load of a sensor on a prismatic joint is a force with the axis
``force``."""


def axes_of(kind: str, slide: bool = False) -> tuple[str, ...]:
    """Return the channels of a kind of sensor.

    Args:
        kind: one of ``AXES``.
        slide: whether a joint torque sensor is on a prismatic joint.
    """
    return ("force",) if kind == JOINT_TORQUE and slide else AXES[kind]


def unit_of(axis: str) -> str:
    """Return the unit of a channel."""
    return {"f": "N", "t": "N*m", "g": "rad/s", "a": "m/s^2"}[axis[0]]


def readings_of(stated: SensorFields, true: FloatArray, period: float) -> FloatArray:
    """(n, k) readings of a sensor from a record.

    Args:
        stated: fields of the sensor; not of a camera.
        true: (n, k) true signals at the sensor's frame.
        period: time between samples, s.
    """
    matrix = [np.array(one) for one in stated.matrix]
    bias = [np.array(one) for one in stated.bias]
    limit = np.array([np.inf if one is None else one for one in stated.limit])
    if stated.kind == IMU:
        read = ImuSensor(matrix[0], bias[0], matrix[1], bias[1]).measured(true)
        return np.asarray(np.clip(read, -limit, limit))
    if stated.kind == JOINT_TORQUE:
        joint = JointTorqueSensor(
            float(bias[0][0]), float(matrix[0][0, 0]), stated.time_constant, float(limit[0])
        )
        return joint.measured(true, period)
    wrist = ForceTorqueSensor(bias[0], matrix[0], stated.time_constant, limit)
    return wrist.measured(true, period)
