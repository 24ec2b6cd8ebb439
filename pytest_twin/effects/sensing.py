"""Sensing effects: errors of encoders and effort sensors."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import (
    MODES,
    Effect,
    Parameter,
    PoseShift,
    RegressorColumn,
    Values,
    World,
)


class EncoderBias(Effect):
    """The encoder's zero differs from the model's zero."""

    id = "encoder_bias"
    family = "sensing"
    stage = "encoder"
    basic_modes = MODES
    nearly_linear = True
    hook_order = 2
    law = "measured = q + bias; the servo regulates q + in_loop bias"
    source = "Mooring, Roth, Driels, Fundamentals of Manipulator Calibration (1991), ch. 2"
    parameters = (
        Parameter("bias", "position", 0.0, -0.6, 0.6, (0.03,), meaning="encoder zero offset"),
        Parameter(
            "in_loop", "one", None, 0.0, 1.0, (0.0, 1.0), choice=True,
            meaning="whether the servo uses this reading",
            choices=("outside the servo loop", "inside the servo loop"),
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "joint_spring": "hold several poses with different loads: a zero offset is the same in all",
        "asymmetric_friction": "approach one pose from both sides and switch the drive off: a zero "
        "offset remains",
        "encoder_scale": "hold poses far apart: a scale error grows with the angle",
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

    def pose_shift(
        self, parameter: str, value: float, unit: str, servo_stiffness: float | None
    ) -> PoseShift | str | None:
        return PoseShift(-1.0, "one")


class EncoderScale(Effect):
    """The encoder's counts per turn, the assumed gear ratio, or the sign of its reading is wrong.

    A scale error of -2 is a reversed sign.
    """

    id = "encoder_scale"
    family = "sensing"
    hook_order = 1
    law = "measured = (1 + scale_error) q"
    source = "Mooring, Roth, Driels, Fundamentals of Manipulator Calibration (1991), ch. 2"
    parameters = (
        # Belts and friction wheels are off by some percent; a wrong ratio or sign is rare.
        Parameter(
            "scale_error", "one", 0.0, -2.2, 0.5, (0.03,), meaning="encoder scale",
            relation="relative", usual=0.05,
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "controller_gain": "hold one pose under two loads: only the error of a gain changes with "
        "the load",
        "encoder_bias": "hold poses far apart: a scale error grows with the angle",
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
        # A scale of zero has no inverse; the reading then tells nothing of the position.
        factor = np.where(np.abs(factor) < 1e-6, 1e-6, factor)
        return position / factor, velocity / factor


class EncoderEccentricity(Effect):
    """The encoder's code wheel is off its axis: an error with one period per turn."""

    id = "encoder_eccentricity"
    family = "sensing"
    periodic = True
    law = "measured = q + sine sin(q) + cosine (cos(q) - zeroed)"
    source = "Hagiwara et al., IEEE Trans. Instrum. Meas. 41 (1992): eccentricity of encoders"
    parameters = (
        Parameter("sine", "position", 0.0, -0.2, 0.2, (0.02,), meaning="sine amplitude"),
        Parameter("cosine", "position", 0.0, -0.2, 0.2, (0.02,), meaning="cosine amplitude"),
        Parameter(
            "zeroed", "one", None, 0.0, 1.0, (1.0, 0.0), choice=True,
            meaning="whether the encoder was set to zero at q = 0",
            choices=("encoder set to zero at q = 0", "encoder not set to zero at q = 0"),
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "encoder_scale": "move through a whole turn: an eccentricity error returns to zero, a "
        "scale error does not",
        "position_dependent_friction": "repeat the motion in both directions: friction changes its "
        "sign",
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
        """Ratio of measured to true velocity."""
        return 1.0 + values["sine"] * np.cos(position) - values["cosine"] * np.sin(position)


class EffortBias(Effect):
    """The effort sensor has a constant offset."""

    id = "effort_bias"
    family = "sensing"
    stage = "drive"
    regressor_symbol = "off"
    needs_effort_sensor = True
    hook_order = 2
    law = "measured effort = effort + bias"
    source = "ISO 376; zero offset of force-proving instruments"
    parameters = (
        Parameter(
            "bias", "effort", 0.0, -10.0, 10.0, (0.05,), "effort", meaning="effort sensor offset"
        ),
    )
    confused_with: ClassVar = {
        "torque_constant": "hold two loads: a sensor offset does not grow with the load",
    }

    def sense_effort(self, effort: FloatArray, values: Values) -> FloatArray:
        return effort + values["bias"][:, None]

    def regressor_column(
        self, position: FloatArray, velocity: FloatArray, acceleration: FloatArray
    ) -> RegressorColumn:
        return RegressorColumn(np.ones_like(velocity))


class EffortScale(Effect):
    """The effort sensor's sensitivity, or the sign of its reading, is wrong.

    A scale error of -2 is a reversed sign.
    """

    id = "effort_scale"
    family = "sensing"
    stage = "drive"
    needs_effort_sensor = True
    hook_order = 1
    law = "measured effort = (1 + scale_error) effort"
    source = "ISO 376; sensitivity of force-proving instruments"
    parameters = (
        Parameter(
            "scale_error", "one", 0.0, -2.2, 1.5, (0.1,), meaning="effort sensor scale",
            relation="relative",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "torque_constant": "compare the motion: a wrong torque constant changes it, a sensor does "
        "not",
    }

    def sense_effort(self, effort: FloatArray, values: Values) -> FloatArray:
        return effort * (1.0 + values["scale_error"][:, None])
