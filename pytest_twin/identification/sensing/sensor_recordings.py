"""Read a sensor's recordings, with the readings of an ideal sensor along the same motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import JointSeries
from pytest_twin.formats.ros_serialization import Integers
from pytest_twin.formats.sensor_bag import SensorCollector, gather_sensors
from pytest_twin.formats.sensor_record import FORCE_TORQUE, IMU, JOINT_TORQUE
from pytest_twin.formats.stamped_readings import IMU as IMU_TYPE
from pytest_twin.identification.sensing.camera_frames import CameraTrial, frames_seen
from pytest_twin.realization import Realization
from pytest_twin.realization.encoders import Encoders, calibration_of
from pytest_twin.realization.ideal_sensors import ideal_sensor_signals, load_at
from pytest_twin.sensors.encoder import encoder_of

_WINDOW_S = 0.1
_DEGREE = 5
"""Window and degree of the polynomial that smooths positions and readings alike. Motion below 5 Hz
passes. A cubic would reduce an acceleration at 2 Hz by 1 %, which biases the torque couplings."""
_FEWEST = 100
"""Smallest number of samples."""
_MOST = 20_000
"""Samples of one recording that are used: the model is evaluated at each."""


@dataclass(frozen=True)
class NamedSensor:
    """A sensor that a user named.

    Attributes:
        name: name of the sensor, as its record calls it.
        frame: site or body in whose axes it reads; for a joint torque sensor, the joint.
    """

    name: str
    topic: str
    frame: str


@dataclass(frozen=True)
class SensorTrial:
    """One recording of one sensor, on a regular grid.

    Attributes:
        period: time between samples, s.
        reading: (n, k) recorded readings, in the SI units of the sensor's kind.
        smoothed: (n, k) readings with the low-pass filter of the motion.
        true: (n, k) readings of an ideal sensor along the smoothed motion.
        kind: ``force_torque``, ``imu`` or ``joint_torque``.
        is_slide: whether a joint torque sensor is on a slide.
        role: role in the recording's metadata, such as ``held_out``; None without one.
        steps: joint -> quantization of its encoder, rad or m; joints that show none are left out.
    """

    path: Path
    period: float
    reading: FloatArray
    smoothed: FloatArray
    true: FloatArray
    kind: str
    is_slide: bool
    role: str | None
    steps: Mapping[str, float]


def read_sensor(
    path: Path,
    sensor: NamedSensor,
    realization: Realization,
    state: str,
    motion: JointSeries | None = None,
) -> SensorTrial | CameraTrial:
    """Read a sensor's readings, and compute those of an ideal sensor along the same motion.

    Args:
        path: MCAP file, rosbag2 folder or ``.db3`` file.
        sensor: its topic and frame.
        realization: the model, with the payload that the recording names.
        state: topic of the joint states.
        motion: joint states that replace the measured ones, such as predicted ones.

    Raises:
        RecordingError: there are no readings or no positions, or both overlap for less than
            100 samples.
    """
    at_joint = sensor.frame in realization.joints
    topics = {"state": state, **({"load": sensor.topic} if at_joint else {})}
    bag = gather_sensors(SensorCollector(path, topics))
    joints = motion or bag.readers["state"].finish()
    if joints is None or joints.position is None:
        raise RecordingError(
            "no joint positions", path=path, value=state,
            expected="joint states in the recording of the sensor; --topics state=/x names their "
            "topic",
        )  # fmt: skip
    if "payload" in bag.metadata and realization.twin is not None and realization.twin.payloads:
        realization = realization.variant(payload=bag.metadata["payload"])
    role = bag.metadata.get("role")
    steps = _steps(joints)
    joints = _in_model(joints, realization)
    if bag.poses.get(sensor.topic):
        poses = bag.poses[sensor.topic]
        stamps = np.array([one.stamp for one in poses], dtype=np.int64)
        values = np.array([one.values for one in poses])
        names = _recorded_joints(joints, realization)
        found = frames_seen(path, sensor.frame, stamps, values, joints, names, realization)
        return replace(found, role=role, steps=steps)
    loads = bag.readers["load"].finish() if at_joint else None
    stamps, values = _readings(path, sensor, bag, loads)
    _, rows = np.unique(stamps, return_index=True)
    values = values[rows]
    zero = int(min(stamps.min(), joints.stamp.min()))
    sensed = np.asarray((stamps[rows] - zero) * 1e-9, dtype=np.float64)
    moved = np.asarray((joints.stamp - zero) * 1e-9, dtype=np.float64)
    period = float(np.median(np.diff(sensed))) if len(sensed) > 1 else 0.0
    start, end = max(sensed[0], moved.min()), min(sensed[-1], moved.max())
    count = int((end - start) / period) + 1 if period > 0.0 and end > start else 0
    if count < _FEWEST:
        raise RecordingError(
            "sensor and joints overlap for too short a time", path=path, where=sensor.topic,
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
    along = smooth[inner], velocity[inner], acceleration[inner]
    if at_joint:
        kind, true = JOINT_TORQUE, load_at(realization, sensor.frame, names, *along)
    elif bag.reading_type[sensor.topic] == IMU_TYPE:
        kind, true = IMU, ideal_sensor_signals(realization, sensor.frame, names, *along).inertial
    else:
        kind, true = (
            FORCE_TORQUE,
            ideal_sensor_signals(realization, sensor.frame, names, *along).wrench,
        )
    return SensorTrial(
        path,
        period,
        reading[inner],
        savgol_filter(reading, window, _DEGREE, axis=0)[inner],
        true,
        kind,
        at_joint and realization.structure.joint_type[sensor.frame] == "slide",
        role,
        steps,
    )


def _readings(
    path: Path, sensor: NamedSensor, bag: SensorCollector, loads: JointSeries | None
) -> tuple[Integers, FloatArray]:
    """Stamps (ns) and (n, k) values of a wrench, an IMU, or the effort of one joint."""
    if loads is not None and loads.effort is not None and sensor.frame in loads.names:
        values = loads.effort[:, loads.names.index(sensor.frame)]
        known = np.isfinite(values)
        if known.any():
            return loads.stamp[known], values[known, None]
    readings = bag.readings.get(sensor.topic)
    if not readings or loads is not None:
        raise RecordingError(
            "no readings of the sensor", path=path, value=f"{sensor.topic} at {sensor.frame}",
            expected="a topic of sensor_msgs/Imu, geometry_msgs/WrenchStamped or, for a camera, "
            "geometry_msgs/PoseStamped at a site or body; or joint states with effort at a joint",
        )  # fmt: skip
    stamps = np.array([one.stamp for one in readings], dtype=np.int64)
    return stamps, np.array([one.values for one in readings])


def _steps(series: JointSeries) -> dict[str, float]:
    assert series.position is not None
    found = {}
    for name, values in zip(series.names, series.position.T, strict=True):
        encoder = encoder_of(values[np.isfinite(values)])
        if encoder is not None:
            found[name] = encoder.step
    return found


def _in_model(series: JointSeries, realization: Realization) -> JointSeries:
    """Convert encoder readings to joint positions of the model, by the twin's calibration."""
    assert series.position is not None
    encoders = Encoders.of(calibration_of(realization), series.names)
    return replace(series, position=encoders.model_position(series.position))


def _positions(
    series: JointSeries, moved: FloatArray, grid: FloatArray, realization: Realization
) -> tuple[tuple[str, ...], FloatArray]:
    """Joints of the model that were recorded, and (n, j) positions on a grid."""
    assert series.position is not None
    names = _recorded_joints(series, realization)
    _, rows = np.unique(moved, return_index=True)
    columns = []
    for name in names:
        values = series.position[rows, series.names.index(name)]
        known = np.isfinite(values)
        columns.append(np.interp(grid, moved[rows][known], values[known]))
    return names, np.column_stack(columns)


def _recorded_joints(series: JointSeries, realization: Realization) -> tuple[str, ...]:
    """Joints of the model that were recorded."""
    names = tuple(name for name in series.names if name in realization.joints)
    if not names:
        raise RecordingError(
            "no joint of the model was recorded", path=realization.path,
            value=", ".join(series.names), expected=", ".join(realization.joints),
        )  # fmt: skip
    return names
