"""Timing effects: delays and clocks that disagree."""

from __future__ import annotations

from typing import ClassVar

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import MODES, Effect, Parameter, PoseShift, Values

_DELAY_OR_LAG = (
    "record steps and a chirp: a delay leaves a dead time, and its phase grows linearly with "
    "frequency; a lag responds at once"
)
_PUSH = "push or release the robot by hand: only a sensor delay shifts the measured response"


class CommandDelay(Effect):
    """The drive acts on each command a fixed time after it was sent."""

    id = "command_delay"
    family = "timing"
    stage = "delay"
    basic_modes = MODES
    nearly_linear = True
    law = "setpoint(t) = command(t - delay)"
    source = "transport delay, e.g. Franklin, Powell, Emami-Naeini, Feedback Control, ch. 5"
    parameters = (
        Parameter(
            "delay", "time", 0.0, 0.0, 0.3, (0.005, 0.015, 0.03, 0.06), meaning="command delay"
        ),
    )
    confused_with: ClassVar = {
        "sensor_delay": _PUSH,
        "actuator_lag": _DELAY_OR_LAG,
        "rate_limit": "record steps of two sizes: only the time lost to a rate limit grows with "
        "the step",
    }

    def command_latency(self, values: Values) -> FloatArray | None:
        return values["delay"]

    def pose_shift(
        self, parameter: str, value: float, unit: str, servo_stiffness: float | None
    ) -> PoseShift | str | None:
        return PoseShift(-1.0, "velocity")


class SensorDelay(Effect):
    """Every sample shows the state a fixed time before its stamp."""

    id = "sensor_delay"
    family = "timing"
    law = "measured(t) = state(t - delay)"
    source = "transport delay, e.g. Franklin, Powell, Emami-Naeini, Feedback Control, ch. 5"
    scope = "robot"
    parameters = (
        Parameter(
            "delay", "time", 0.0, 0.0, 0.3, (0.005, 0.015, 0.03, 0.06), meaning="sensor delay"
        ),
    )
    confused_with: ClassVar = {"command_delay": _PUSH}

    def sample_time(self, time: FloatArray, values: Values) -> FloatArray:
        return time - values["delay"][:, None]

    def pose_shift(
        self, parameter: str, value: float, unit: str, servo_stiffness: float | None
    ) -> PoseShift | str | None:
        return PoseShift(-1.0, "velocity")


class ClockDrift(Effect):
    """The clock that stamps measurements runs faster than the clock that stamps commands."""

    id = "clock_drift"
    family = "timing"
    law = "measured(t) = state(t (1 - drift))"
    source = "affine clock model, e.g. Mills, Computer Network Time Synchronization, ch. 1"
    scope = "robot"
    parameters = (Parameter("drift", "one", 0.0, -0.02, 0.02, (0.002,), meaning="clock drift"),)
    confused_with: ClassVar = {
        "sensor_delay": "make a long recording: the error of a drift grows with time, that of a "
        "delay does not",
    }

    def sample_time(self, time: FloatArray, values: Values) -> FloatArray:
        return time * (1.0 - values["drift"][:, None])
