"""Timing: what comes late, and clocks that do not agree."""

from __future__ import annotations

from typing import ClassVar

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import Effect, Parameter, Values

_LATE_OR_LAGGING = (
    "steps: a pure delay leaves a dead time, a lag rises at once; chirp: the phase of a delay "
    "grows linearly with frequency"
)


class CommandDelay(Effect):
    """The drive acts on the command of some time ago."""

    id = "command_delay"
    family = "timing"
    of_every_drive = True
    law = "setpoint(t) = command(t - delay)"
    source = "transport delay, e.g. Franklin, Powell, Emami-Naeini, Feedback Control, ch. 5"
    parameters = (Parameter("delay", "time", 0.0, 0.0, 0.3, (0.005, 0.015, 0.03, 0.06)),)
    confused_with: ClassVar = {
        "sensor_delay": "an outside disturbance or a release: only a sensor delay shifts it",
        "actuator_lag": _LATE_OR_LAGGING,
        "rate_limit": "steps of two sizes: a delay does not grow with the step",
    }

    def command_delay(self, values: Values) -> FloatArray | None:
        return values["delay"]


class SensorDelay(Effect):
    """Every measurement is of some time ago."""

    id = "sensor_delay"
    family = "timing"
    law = "measured(t) = state(t - delay)"
    source = "transport delay, e.g. Franklin, Powell, Emami-Naeini, Feedback Control, ch. 5"
    scope = "robot"
    parameters = (Parameter("delay", "time", 0.0, 0.0, 0.3, (0.005, 0.015, 0.03, 0.06)),)
    confused_with: ClassVar = {
        "command_delay": "an outside disturbance or a release: only a sensor delay shifts it",
    }

    def sample_time(self, time: FloatArray, values: Values) -> FloatArray:
        return time - values["delay"][:, None]


class ClockDrift(Effect):
    """The clock that stamps measurements runs faster than the one that stamps commands."""

    id = "clock_drift"
    family = "timing"
    law = "measured(t) = state(t (1 - drift))"
    source = "affine clock model, e.g. Mills, Computer Network Time Synchronization, ch. 1"
    scope = "robot"
    parameters = (Parameter("drift", "one", 0.0, -0.02, 0.02, (0.002,)),)
    confused_with: ClassVar = {
        "sensor_delay": "a long recording: a drift grows with time, a delay does not",
    }

    def sample_time(self, time: FloatArray, values: Values) -> FloatArray:
        return time * (1.0 - values["drift"][:, None])
