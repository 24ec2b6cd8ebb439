"""Data classes of the report of a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pytest_twin.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Regime:
    """RMS errors in one regime of the motion.

    Attributes:
        name: description with units.
        before, after: RMS error of the model and of the patched model, rad or m.
    """

    name: str
    before: float
    after: float
    share: float


@dataclass(frozen=True, slots=True)
class JointView:
    """Data of one joint's figure.

    Attributes:
        unit: ``rad`` or ``m``.
        recording: recording that is drawn over time.
        time, measured, before, after: (n,) time [s], measured position, and predictions of model
            and patched model in this recording.
        command_time, command: (m,) time and position commands, or None.
        left_before, left_after: (s,) residuals, measured minus predicted, in the test recordings.
        velocity, position, load: (s,) motion at these samples; rad/s or m/s, and N*m or N.
        stretches: number of samples of each test recording; they add up to s.
        interval: median sampling interval, s.
        regimes: RMS errors by regime.
        windows: (effect, start, end) of the findings in the drawn recording, s.
    """

    joint: str
    unit: str
    recording: str
    time: FloatArray
    measured: FloatArray
    before: FloatArray
    after: FloatArray
    command_time: FloatArray | None
    command: FloatArray | None
    floor: float
    left_before: FloatArray
    left_after: FloatArray
    velocity: FloatArray
    position: FloatArray
    load: FloatArray
    stretches: tuple[int, ...]
    interval: float
    regimes: tuple[Regime, ...]
    windows: tuple[tuple[str, float, float], ...]


@dataclass(frozen=True, slots=True)
class DiagnosisView:
    """Content of one report.

    Attributes:
        model: name of the diagnosed model.
        created: RFC 3339.
        document: content of ``diagnosis.json``.
        joints: figures, the largest error in noise floors first.
        floor_parts: source -> joint -> RMS in the joint's unit.
        is_simulated: whether predictions contain the integration error of the time step.
        step_left: share of that error that is in the floor.
        native: changes in the patched MJCF, one line each.
        outside_mjcf: effects that MJCF cannot express, applied by ``pytest-twin replay``.
        tried: number of candidate effects.
        laws: effect -> (equation, source).
        at_floor: noise floors up to which a joint is explained, see
            :mod:`pytest_twin.diagnosis.verdict`.
    """

    model: str
    created: str
    document: Mapping[str, Any]
    joints: tuple[JointView, ...]
    floor_parts: Mapping[str, Mapping[str, float]]
    is_simulated: bool
    step_left: float
    native: tuple[str, ...]
    outside_mjcf: tuple[str, ...]
    tried: int
    laws: Mapping[str, tuple[str, str]]
    at_floor: float
