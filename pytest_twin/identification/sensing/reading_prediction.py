"""Predict the readings of a twin's sensors along a predicted motion, and compare."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.errors import TwinError
from pytest_twin.formats.recording import JointSeries
from pytest_twin.formats.sensor_record import CAMERA, SensorFields
from pytest_twin.identification.sensing.camera_frames import CameraTrial, turn_errors
from pytest_twin.identification.sensing.sensor_recordings import (
    NamedSensor,
    SensorTrial,
    read_sensor,
)
from pytest_twin.realization import Realization
from pytest_twin.sensors.encoder import Encoder
from pytest_twin.sensors.identified_sensors import axes_of, readings_of, unit_of
from pytest_twin.twin import Twin


def encoders_of(twin: Twin | None) -> dict[str, Encoder]:
    """Return joint -> quantization of its encoder, from the valid records."""
    records = () if twin is None else twin.fits_in_use
    steps = {joint: step for one in records for joint, step in one.encoder_steps.items()}
    return {joint: Encoder(step) for joint, step in steps.items()}


def sensors_of(twin: Twin | None) -> dict[str, SensorFields]:
    """Return name -> sensor, from the valid records; later records take precedence."""
    records = () if twin is None else twin.fits_in_use
    return {one.name: one for record in records for one in record.sensors}


def as_encoders_read(series: JointSeries, encoders: Mapping[str, Encoder]) -> JointSeries:
    """Return predicted positions quantized by the encoders."""
    if series.position is None or not set(encoders) & set(series.names):
        return series
    position = series.position.copy()
    for column, joint in enumerate(series.names):
        if joint in encoders:
            position[:, column] = encoders[joint].measured(position[:, column])
    return replace(series, position=position)


def compare_readings(
    sensors: Mapping[str, SensorFields],
    path: Path,
    realization: Realization,
    motion: JointSeries,
    state: str,
) -> tuple[dict[str, Any], list[str]]:
    """Return RMS differences between predicted and recorded readings.

    The sensor's model is applied to the true signal along the predicted motion. The difference for
    an ideal sensor is returned too.

    Args:
        motion: predicted joint states, before quantization by the encoders.
        state: topic of the joint states.

    Returns:
        Sensor -> ``rms`` and ``rms_ideal`` by axis, with ``unit``; and notes about sensors without
        readings in the recording.
    """
    found: dict[str, Any] = {}
    notes = []
    for name, stated in sensors.items():
        mounted = NamedSensor(name, stated.topic, stated.frame)
        try:
            trial = read_sensor(path, mounted, realization, state, motion)
        except TwinError as error:
            notes.append(f"sensor {name} is not compared: {error}")
            continue
        if isinstance(trial, CameraTrial) != (stated.kind == CAMERA):
            notes.append(
                f"sensor {name} is not compared: {stated.topic} holds other messages than those "
                f"of its kind, {stated.kind}"
            )
            continue
        found[name] = {
            "kind": stated.kind, "topic": stated.topic, "frame": stated.frame,
            **(_camera(trial, stated) if isinstance(trial, CameraTrial) else _read(trial, stated)),
        }  # fmt: skip
    return found, notes


def _read(trial: SensorTrial, stated: SensorFields) -> dict[str, Any]:
    axes = axes_of(stated.kind, trial.is_slide)
    predicted = readings_of(stated, trial.true, trial.period)
    return {
        "rms": _by_axis(axes, trial.smoothed - predicted),
        "rms_ideal": _by_axis(axes, trial.smoothed - trial.true),
        "unit": {axis: unit_of(axis) for axis in axes},
    }


def _camera(trial: CameraTrial, stated: SensorFields) -> dict[str, Any]:
    return {
        "rms": {"turn": turn_errors([trial], stated.delay, stated.mount)},
        "rms_ideal": {"turn": turn_errors([trial], 0.0, stated.mount)},
        "unit": {"turn": "rad"},
    }


def _by_axis(axes: tuple[str, ...], errors: Any) -> dict[str, float]:
    rms = np.sqrt(np.mean(errors**2, axis=0))
    return {axis: float(value) for axis, value in zip(axes, rms, strict=True)}
