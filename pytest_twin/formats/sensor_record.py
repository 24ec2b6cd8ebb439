"""Read the sensors of ``identification.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pytest_twin.formats.record_fields import Matrix, number, numbers, text

FORCE_TORQUE, IMU, JOINT_TORQUE, CAMERA = "force_torque", "imu", "joint_torque", "camera"
GROUPS: Mapping[str, tuple[int, ...]] = {FORCE_TORQUE: (6,), IMU: (3, 3), JOINT_TORQUE: (1,)}
"""Kind -> number of channels in each block with a calibration matrix of its own."""


@dataclass(frozen=True, slots=True)
class SensorFields:
    """Parameters with which a simulation computes the readings of one sensor.

    Attributes:
        name: name of the sensor.
        kind: ``force_torque``, ``imu``, ``joint_torque`` or ``camera``.
        topic: topic of its readings.
        frame: site or body in whose axes it measures; for a joint torque sensor its joint.
        matrix, bias: calibration matrix and bias of each block of channels.
        time_constant: time constant of the low-pass filter, s.
        limit: largest magnitude of each channel; None for no limit.
        delay, period, jitter: for a camera, s.
        lost: fraction of a camera's frames that are lost.
        mount: for a camera, ``hand`` or ``world``.
    """

    name: str
    kind: str
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
    mount: str = "world"


def sensor_fields(name: str, one: Mapping[str, Any]) -> SensorFields:
    """Read one sensor.

    Raises:
        ValueError, KeyError, TypeError, AttributeError: the fields are not what
            ``pytest-twin identify`` writes.
    """
    kind = text(one["kind"])
    topic, frame = text(one["topic"]), text(one["frame"])
    if kind == CAMERA:
        if one["mount"] not in ("hand", "world"):
            raise ValueError(f"mount {one['mount']!r}")
        return SensorFields(
            name, kind, topic, frame, delay=number(one["delay"]), period=number(one["period"]),
            jitter=number(one["jitter"]), lost=number(one["lost"]), mount=one["mount"],
        )  # fmt: skip
    if kind not in GROUPS:
        raise ValueError(f"kind of sensor {kind!r}")
    groups = GROUPS[kind]
    matrices, biases = list(one["matrix"]), list(one["bias"])
    if len(matrices) != len(groups) or len(biases) != len(groups):
        raise ValueError(f"not {len(groups)} blocks")
    for rows, size in zip(matrices, groups, strict=True):
        if not isinstance(rows, list) or len(rows) != size:
            raise ValueError(f"matrix: not {size} rows")
    limits = list(one["limit"])
    if len(limits) != sum(groups):
        raise ValueError(f"not {sum(groups)} limits")
    return SensorFields(
        name, kind, topic, frame,
        matrix=tuple(
            tuple(numbers(row, size) for row in rows)
            for rows, size in zip(matrices, groups, strict=True)
        ),
        bias=tuple(numbers(row, size) for row, size in zip(biases, groups, strict=True)),
        time_constant=number(one["time_constant"]),
        limit=tuple(None if v is None else number(v) for v in limits),
    )  # fmt: skip
