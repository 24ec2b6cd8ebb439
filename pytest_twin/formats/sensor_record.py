"""Read the sensors of ``identification.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from pytest_twin.formats import typed
from pytest_twin.formats.record_fields import Matrix

FORCE_TORQUE, IMU, JOINT_TORQUE, CAMERA = "force_torque", "imu", "joint_torque", "camera"
GROUPS: Mapping[str, tuple[int, ...]] = {FORCE_TORQUE: (6,), IMU: (3, 3), JOINT_TORQUE: (1,)}
"""Kind -> number of channels in each block with a calibration matrix of its own."""
_CAMERA_FIELDS = frozenset({"delay", "period", "jitter", "lost", "mount"})
_CHANNEL_FIELDS = frozenset({"matrix", "bias", "time_constant", "limit"})


@dataclass(frozen=True, slots=True)
class SensorFields:
    """Parameters with which a simulation computes the readings of one sensor.

    Attributes:
        kind: ``force_torque``, ``imu``, ``joint_torque`` or ``camera``.
        frame: site or body in whose axes it measures; for a joint torque sensor its joint.
        matrix, bias: calibration matrix and bias of each block of channels.
        time_constant: time constant of the low-pass filter, s.
        limit: largest magnitude of each channel; None for no limit.
        delay, period, jitter: for a camera, s.
        lost: fraction of a camera's frames that are lost.
        mount: for a camera, ``hand`` or ``world``.
    """

    name: str
    kind: Literal["force_torque", "imu", "joint_torque", "camera"]
    topic: str
    frame: str
    matrix: tuple[Matrix, ...] = ()
    bias: tuple[tuple[float, ...], ...] = ()
    time_constant: float = 0.0
    limit: tuple[float | None, ...] = ()
    delay: float = 0.0
    period: float = 0.0
    jitter: float = 0.0
    lost: float = 0.0
    mount: Literal["hand", "world"] = "world"


def sensor_fields(name: str, one: Mapping[str, Any]) -> SensorFields:
    """Read one sensor.

    Raises:
        ValueError, KeyError, TypeError, AttributeError: the fields are not what
            ``pytest-twin identify`` writes.
    """
    sensor = typed.build({**one, "name": name}, SensorFields)
    missing = (_CAMERA_FIELDS if sensor.kind == CAMERA else _CHANNEL_FIELDS) - set(one)
    if missing:
        raise KeyError(min(missing))
    if sensor.kind == CAMERA:
        return sensor
    sizes = GROUPS[sensor.kind]
    found = tuple(len(rows) for rows in sensor.matrix)
    rows_fit = all(len(row) == len(rows) for rows in sensor.matrix for row in rows)
    if found != sizes or not rows_fit or tuple(map(len, sensor.bias)) != sizes:
        raise ValueError(f"matrix and bias: not {len(sizes)} blocks of {sizes[0]} channels")
    if len(sensor.limit) != sum(sizes):
        raise ValueError(f"not {sum(sizes)} limits")
    return sensor
