"""Identify named sensors, from recordings to the content of ``identification.json``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.linalg import block_diag

from pytest_twin import __version__
from pytest_twin.errors import RecordingError
from pytest_twin.estimation.roles import split_by_role
from pytest_twin.formats.sensor_record import CAMERA, IMU, JOINT_TORQUE
from pytest_twin.identification.document import nominal_document, parameter_entry, verdict_of
from pytest_twin.identification.sensing.camera_frames import CameraTrial
from pytest_twin.identification.sensing.estimate import (
    SensorEstimate,
    estimate,
    estimate_camera,
)
from pytest_twin.identification.sensing.sensor_recordings import (
    NamedSensor,
    SensorTrial,
    read_sensor,
)
from pytest_twin.identification.stages import HeldOut, Stage, judge_stage
from pytest_twin.identification.write import write_fitted
from pytest_twin.realization import Realization
from pytest_twin.sensors.imu import noise_of
from pytest_twin.time_limit import skips
from pytest_twin.trial.roles import FINAL, refuse_final

_Trial = SensorTrial | CameraTrial
_STILL = 0.005
"""Largest angular speed at the sensor, rad/s, of a recording at rest."""
_MOTION = (
    "turn the sensor through many orientations, with payloads whose centres of mass differ, and "
    "move fast enough that inertia adds to the weight"
)

_GIVEN = {
    JOINT_TORQUE: "mass and inertia of the links beyond the joint are given",
    CAMERA: "no mounting of the camera or its target is needed",
}


def identify_sensors(
    realization: Realization,
    recordings: Sequence[Path],
    held_out: Sequence[Path],
    sensors: Sequence[NamedSensor],
    state: str,
    folder: Path,
    progress: Callable[[float], None] = lambda fraction: None,
) -> dict[str, Any]:
    """Estimate sensors, and write the unchanged model.

    Args:
        recordings, held_out: bags with joint states and the sensors' topics.
        sensors: names, topics and frames of the sensors.
        state: topic of the joint states.
        folder: empty folder for the model.
        progress: called with the fraction done.

    Returns:
        The content of ``identification.json`` without its inputs.

    Raises:
        TwinError: the input cannot be used.
    """
    stages: list[Stage] = []
    parameters: dict[str, Any] = {}
    named: list[str] = []
    blocks: list[np.ndarray] = []
    held: dict[str, Any] = {}
    unobservable: list[dict[str, str]] = []
    models: dict[str, Any] = {}
    notes: list[str] = []
    steps: dict[str, float] = {}
    better = True
    names: dict[str, list[str]] = {"fit": [], "held_out": []}
    for done, sensor in enumerate(sensors, 1):
        if skips(f"sensor {sensor.name}"):
            continue
        fit, tested = _by_role(recordings, held_out, sensor, realization, state, notes)
        names = {
            "fit": [one.path.name for one in fit], "held_out": [one.path.name for one in tested],
        }  # fmt: skip
        found = _estimate_of(fit, tested, sensor)
        own = [f"{sensor.name}.{name}" for name in found.names]
        before, after = _total(found.nominal, found), _total(found.error, found)
        stage = Stage(
            "sensor", "accepted", f"{sensor.name}: {sensor.topic} at {sensor.frame}", tuple(own),
            excludes=_GIVEN.get(found.kind, "payload and frame of the model are given"),
        )  # fmt: skip
        if tested:
            stage = judge_stage(stage, HeldOut(before, after, "of an ideal sensor's error"))
        better = better and after < before
        stages.append(stage)
        half = found.quantile * np.sqrt(np.diag(found.covariance).clip(0.0))
        for name, value, unit, width in zip(own, found.values, found.units, half, strict=True):
            parameters[name] = parameter_entry(
                value, width, unit, prior=1.0 if "sensor_scale" in name else 0.0, stage="sensor"
            )
        named += own
        blocks.append(found.covariance)
        axes = found.axes
        held[sensor.name] = {
            "sensor_rms": {axis: float(v) for axis, v in zip(axes, found.error, strict=True)},
            "sensor_rms_nominal": {
                axis: float(v) for axis, v in zip(axes, found.nominal, strict=True)
            },
            "sensor_units": dict(zip(axes, found.axis_units, strict=True)),
        }
        unobservable += [
            {"expression": f"{sensor.name}: {words}", "motion": _MOTION}
            for words in found.undetermined
        ]
        models[sensor.name] = {"topic": sensor.topic, "frame": sensor.frame, **found.fields}
        for one in fit:
            steps.update(one.steps)
        noise = _noise(fit) if found.kind == IMU else None
        if noise is not None:
            models[sensor.name]["noise"] = dict(zip(axes, noise, strict=True))
        progress(done / len(sensors))
    write_fitted(folder, realization)
    return {
        **nominal_document("readings of sensors beside an ideal sensor along the measured motion"),
        "verdict": verdict_of(stages, better, bool(names["held_out"]), True),
        "tested_on": "held-out recordings" if names["held_out"] else "the fitted recordings",
        "stages": [stage.to_json() for stage in stages],
        "parameters": parameters,
        "covariance": {
            "names": named,
            "matrix": (block_diag(*blocks) if blocks else np.zeros((0, 0))).tolist(),
        },
        "held_out": held,
        "unobservable": unobservable,
        "sensors": models,
        "encoder_steps": steps,
        "trials": names,
        "notes": list(dict.fromkeys(notes)),
        "software": {"pytest-twin": __version__, "mujoco": mujoco.__version__},
    }


def _by_role(
    recordings: Sequence[Path],
    held_out: Sequence[Path],
    sensor: NamedSensor,
    realization: Realization,
    state: str,
    notes: list[str],
) -> tuple[list[_Trial], list[_Trial]]:
    """Split recordings by role, in the same way as other identifications."""
    aside = {path.resolve() for path in held_out}
    fit = [
        read_sensor(path, sensor, realization, state)
        for path in dict.fromkeys(recordings)
        if path.resolve() not in aside
    ]
    tested = [read_sensor(path, sensor, realization, state) for path in dict.fromkeys(held_out)]
    for one in (*fit, *tested):
        if one.role == FINAL:
            refuse_final({"role": one.role}, one.path, "an identification")
    return split_by_role(
        fit, tested, lambda one: one.role, lambda one: one.path, notes, is_named=bool(held_out)
    )


def _total(errors: np.ndarray, found: SensorEstimate) -> float:
    """Total error of all channels, each relative to the ideal sensor's error."""
    return float(np.sqrt(np.mean((errors / np.maximum(found.nominal, 1e-300)) ** 2)))


def _estimate_of(
    fit: Sequence[_Trial], tested: Sequence[_Trial], sensor: NamedSensor
) -> SensorEstimate:
    linear = [[one for one in part if isinstance(one, SensorTrial)] for part in (fit, tested)]
    frames = [[one for one in part if isinstance(one, CameraTrial)] for part in (fit, tested)]
    kinds = {getattr(one, "kind", "camera") for one in (*fit, *tested)}
    if len(kinds) > 1:
        raise RecordingError(
            "a topic of several types", path=fit[0].path, value=", ".join(sorted(kinds)),
            where=sensor.topic, expected="the same type of message in every recording",
        )  # fmt: skip
    return estimate(*linear) if linear[0] else estimate_camera(*frames)


def _noise(fit: Sequence[_Trial]) -> list[dict[str, float | None]] | None:
    """Noise of each channel in the longest recording at rest, or None without one."""
    inertial = [one for one in fit if isinstance(one, SensorTrial)]
    still = [one for one in inertial if np.abs(one.true[:, :3]).max() < _STILL]
    longest = max(still, key=lambda one: len(one.reading) * one.period, default=None)
    if longest is None:
        return None
    return [asdict(one) for one in noise_of(longest.reading, 1.0 / longest.period)]
