"""A sensor's readings beside what an ideal sensor at its frame would read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import JointSeries
from pytest_twin.formats.sensor_bag import SensorGatherer, gather_sensors
from pytest_twin.formats.stamped_readings import IMU
from pytest_twin.realization import Realization
from pytest_twin.realization.sensed import sensed_at
from pytest_twin.sensors.encoder import encoder_of

_WINDOW_S = 0.1
_DEGREE = 5
"""Window and degree of the polynomial that smooths positions and readings alike. Motion below 5 Hz
passes. A cubic would reduce an acceleration at 2 Hz by 1 %, which biases the torque couplings."""
_FEWEST = 100
_MOST = 20_000
"""Samples of one recording that are used: the model is evaluated at each."""


@dataclass(frozen=True)
class Mounted:
    """A sensor that a user named.

    Attributes:
        name: of the sensor.
        topic: of its readings.
        frame: site or body of the model in whose axes it reads.
    """

    name: str
    topic: str
    frame: str


@dataclass(frozen=True)
class SensorTrial:
    """One recording of one sensor, on a regular grid.

    Attributes:
        path: the recording.
        period: s between samples.
        reading: (n, 6) as recorded.
        smoothed: (n, 6) low-passed as the motion was.
        true: (n, 6) of an ideal sensor along the smoothed motion.
        inertial: whether the sensor is an IMU; else a force-torque sensor.
        role: what the recording says of itself.
        steps: joint -> quantization of its encoder, rad or m; joints that show none are left out.
    """

    path: Path
    period: float
    reading: FloatArray
    smoothed: FloatArray
    true: FloatArray
    inertial: bool
    role: str | None
    steps: Mapping[str, float]


def read_sensor(path: Path, sensor: Mounted, realization: Realization, state: str) -> SensorTrial:
    """Readings of a sensor and the true signal beside them.

    Args:
        path: MCAP file, rosbag2 folder or ``.db3`` file.
        sensor: its topic and frame.
        realization: the model, with the payload that the recording names.
        state: topic of the joint states.

    Raises:
        RecordingError: no readings, no positions, or too little of both at once.
    """
    bag = gather_sensors(SensorGatherer(path, {"state": state}))
    joints = bag.readers["state"].finish()
    readings = bag.readings.get(sensor.topic)
    if not readings or joints is None or joints.position is None:
        raise RecordingError(
            "no readings of the sensor" if not readings else "no joint positions",
            path=path,
            value=sensor.topic if not readings else state,
            expected="a topic of sensor_msgs/Imu or geometry_msgs/WrenchStamped"
            if not readings
            else "joint states beside the sensor; --topics state=/x names their topic",
        )
    if "payload" in bag.metadata:
        realization = realization.variant(payload=bag.metadata["payload"])
    stamps = np.array([one.stamp for one in readings], dtype=np.int64)
    _, rows = np.unique(stamps, return_index=True)
    values = np.array([readings[row].values for row in rows])
    zero = int(min(stamps.min(), joints.stamp.min()))
    sensed = np.asarray((stamps[rows] - zero) * 1e-9, dtype=np.float64)
    moved = np.asarray((joints.stamp - zero) * 1e-9, dtype=np.float64)
    period = float(np.median(np.diff(sensed))) if len(sensed) > 1 else 0.0
    start, end = max(sensed[0], moved.min()), min(sensed[-1], moved.max())
    count = int((end - start) / period) + 1 if period > 0.0 and end > start else 0
    if count < _FEWEST:
        raise RecordingError(
            "too little of sensor and joints at once", path=path, where=sensor.topic,
            value=f"{max(count, 0)} samples", expected=f"at least {_FEWEST}",
        )  # fmt: skip
    count = min(count, _MOST)
    grid = start + period * np.arange(count)
    names, position = _positions(joints, moved, grid, realization)
    window = max(_DEGREE + 2, 2 * int(0.5 * _WINDOW_S / period) + 1)
    smooth, velocity, acceleration = (
        savgol_filter(position, window, _DEGREE, deriv, period, axis=0) for deriv in range(3)
    )
    reading = np.column_stack([np.interp(grid, sensed, column) for column in values.T])
    inner = slice(window // 2, count - window // 2)
    ideal = sensed_at(
        realization, sensor.frame, names, smooth[inner], velocity[inner], acceleration[inner]
    )
    inertial = bag.reading_type[sensor.topic] == IMU
    return SensorTrial(
        path,
        period,
        reading[inner],
        savgol_filter(reading, window, _DEGREE, axis=0)[inner],
        ideal.inertial if inertial else ideal.wrench,
        inertial,
        bag.metadata.get("role"),
        _steps(joints),
    )


def _steps(series: JointSeries) -> dict[str, float]:
    assert series.position is not None
    found = {}
    for name, values in zip(series.names, series.position.T, strict=True):
        encoder = encoder_of(values[np.isfinite(values)])
        if encoder is not None:
            found[name] = encoder.step
    return found


def _positions(
    series: JointSeries, moved: FloatArray, grid: FloatArray, realization: Realization
) -> tuple[tuple[str, ...], FloatArray]:
    """Joints of the model that were recorded, and (n, j) positions on a grid."""
    assert series.position is not None
    names = tuple(name for name in series.names if name in realization.joints)
    if not names:
        raise RecordingError(
            "no joint of the model was recorded", path=realization.path,
            value=", ".join(series.names), expected=", ".join(realization.joints),
        )  # fmt: skip
    _, rows = np.unique(moved, return_index=True)
    columns = []
    for name in names:
        values = series.position[rows, series.names.index(name)]
        known = np.isfinite(values)
        columns.append(np.interp(grid, moved[rows][known], values[known]))
    return names, np.column_stack(columns)
