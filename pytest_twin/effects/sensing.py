"""Sensing: what the encoder and the effort sensor say of a motion that is right."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import Effect, Parameter, Values, World


class EncoderBias(Effect):
    """The measured zero is not the model's; a servo that closes its loop on it is off as well."""

    id = "encoder_bias"
    family = "sensing"
    reads_after = 2
    of_every_drive = True
    law = "measured = position + bias; the servo regulates position + in_loop bias, in_loop 0 or 1"
    source = "Mooring, Roth, Driels, Fundamentals of Manipulator Calibration (1991), ch. 2"
    parameters = (
        Parameter("bias", "position", 0.0, -0.6, 0.6, (0.03,)),
        Parameter("in_loop", "one", None, 0.0, 1.0, (0.0, 1.0), choice=True),
    )
    confused_with: ClassVar = {
        "joint_spring": "hold at several poses: a bias does not depend on the pose's load",
        "asymmetric_friction": "approach a pose from both sides, then hold with the drive off",
        "encoder_scale": "poses far apart: a scale error grows with the angle",
    }

    def sense(
        self, time: FloatArray, position: FloatArray, velocity: FloatArray, values: Values
    ) -> tuple[FloatArray, FloatArray]:
        return position + values["bias"][:, None], velocity

    def gains(self, world: World, values: Values) -> None:
        world.offset = world.offset - world.stiffness * values["in_loop"] * values["bias"]

    def unsense(
        self, position: FloatArray, velocity: FloatArray, values: Values
    ) -> tuple[FloatArray, FloatArray]:
        return position - values["bias"], velocity


class EncoderScale(Effect):
    """Counts per turn, or the gear ratio behind them, differ from what is assumed."""

    id = "encoder_scale"
    family = "sensing"
    reads_after = 1
    law = "measured = (1 + scale_error) position"
    source = "Mooring, Roth, Driels, Fundamentals of Manipulator Calibration (1991), ch. 2"
    parameters = (Parameter("scale_error", "one", 0.0, -0.5, 0.5, (0.03,)),)
    confused_with: ClassVar = {
        "controller_gain": "static poses: a scale error stands still, a gain acts with the load",
        "encoder_bias": "poses far apart",
    }

    def sense(
        self, time: FloatArray, position: FloatArray, velocity: FloatArray, values: Values
    ) -> tuple[FloatArray, FloatArray]:
        factor = 1.0 + values["scale_error"][:, None]
        return position * factor, velocity * factor

    def unsense(
        self, position: FloatArray, velocity: FloatArray, values: Values
    ) -> tuple[FloatArray, FloatArray]:
        factor = 1.0 + values["scale_error"]
        return position / factor, velocity / factor


class EncoderEccentricity(Effect):
    """The code wheel is mounted off its axis: an error of one period a turn."""

    id = "encoder_eccentricity"
    family = "sensing"
    law = "measured = q + sine sin(q) + cosine (cos(q) - zeroed), zeroed 0 or 1: set to 0 at q = 0"
    source = "Hagiwara et al., IEEE Trans. Instrum. Meas. 41 (1992): eccentricity of encoders"
    parameters = (
        Parameter("sine", "position", 0.0, -0.2, 0.2, (0.02,)),
        Parameter("cosine", "position", 0.0, -0.2, 0.2, (0.02,)),
        Parameter("zeroed", "one", None, 0.0, 1.0, (1.0, 0.0), choice=True),
    )
    confused_with: ClassVar = {
        "encoder_scale": "a whole turn: an eccentricity closes, a scale error does not",
        "position_dependent_friction": "both directions: friction changes its sign",
    }

    def sense(
        self, time: FloatArray, position: FloatArray, velocity: FloatArray, values: Values
    ) -> tuple[FloatArray, FloatArray]:
        values = {n: x[:, None] for n, x in values.items()}
        return self._read(position, values), velocity * self._rate(position, values)

    def unsense(
        self, position: FloatArray, velocity: FloatArray, values: Values
    ) -> tuple[FloatArray, FloatArray]:
        true = position
        for _ in range(20):
            # A contraction: the error's slope is below one within its bounds.
            nearer = true + position - self._read(true, values)
            if np.array_equal(nearer, true):
                break
            true = nearer
        return true, velocity / self._rate(true, values)

    def _read(self, position: FloatArray, values: Values) -> FloatArray:
        sine, cosine, zeroed = (values[n] for n in ("sine", "cosine", "zeroed"))
        return position + sine * np.sin(position) + cosine * (np.cos(position) - zeroed)

    def _rate(self, position: FloatArray, values: Values) -> FloatArray:
        """What it makes of a velocity."""
        return 1.0 + values["sine"] * np.cos(position) - values["cosine"] * np.sin(position)


class EffortBias(Effect):
    """The effort sensor does not read zero where nothing pulls."""

    id = "effort_bias"
    family = "sensing"
    reads_after = 2
    law = "measured effort = effort + bias"
    source = "ISO 376; zero offset of force-proving instruments"
    parameters = (Parameter("bias", "effort", 0.0, -10.0, 10.0, (0.05,), "effort"),)
    confused_with: ClassVar = {
        "torque_constant": "two loads: a bias does not grow with the load",
    }

    def sense_effort(self, effort: FloatArray, values: Values) -> FloatArray:
        return effort + values["bias"][:, None]


class EffortScale(Effect):
    """The effort sensor's sensitivity is off."""

    id = "effort_scale"
    family = "sensing"
    reads_after = 1
    law = "measured effort = (1 + scale_error) effort"
    source = "ISO 376; sensitivity of force-proving instruments"
    parameters = (Parameter("scale_error", "one", 0.0, -0.8, 1.5, (0.1,)),)
    confused_with: ClassVar = {
        "torque_constant": "the motion: a wrong torque constant changes it, a sensor does not",
    }

    def sense_effort(self, effort: FloatArray, values: Values) -> FloatArray:
        return effort * (1.0 + values["scale_error"][:, None])
