"""Actuation effects: how a drive responds to its command."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import Effect, Parameter, PoseShift, Values, World
from pytest_twin.effects.fast_clip import fast_clip


class _Filter(Protocol):
    """A filter with memory."""

    is_active: bool

    def mean(self, filter_input: FloatArray) -> FloatArray:
        """(rows, joints) mean output over the next step for the input ``filter_input``."""

    def hold(self, filter_input: FloatArray, steps: FloatArray) -> None:
        """Hold the (rows, joints) input for a number of steps, fractions included."""


class _FilterEffect(Effect):
    """A filter on the setpoint before the control law, or on the effort after it."""

    remembers = True

    def initial_filters(self, world: World, values: Values) -> tuple[_Filter, _Filter]:
        """Filters of the setpoint and of the effort at the start of a motion."""
        raise NotImplementedError

    def command(self, world: World, values: Values) -> None:
        world.setpoint = self._filters(world, values)[0].mean(world.setpoint)

    def follow_commands(
        self, world: World, values: Values, commands: Iterable[tuple[FloatArray, FloatArray]]
    ) -> None:
        setpoint, _ = self._filters(world, values)
        if setpoint.is_active:
            for command, seconds in commands:
                setpoint.hold(command, seconds / world.timestep)

    def drive(self, world: World, values: Values) -> None:
        world.delivered = self._filters(world, values)[1].mean(world.delivered)

    def _filters(self, world: World, values: Values) -> tuple[_Filter, _Filter]:
        found: tuple[_Filter, _Filter] | None = world.state.get(self.id)
        if found is None:
            found = world.state[self.id] = self.initial_filters(world, values)
        return found


class ActuatorLag(_FilterEffect):
    """The drive responds with a first-order lag, in its effort or in its setpoint."""

    id = "actuator_lag"
    family = "actuation"
    stage = "drive"
    law = (
        "of_setpoint 0: time_constant d(delivered)/dt = drive - delivered; "
        "of_setpoint 1 (servos): time_constant d(setpoint)/dt = command - setpoint"
    )
    source = (
        "current loop as a first-order lag; Siciliano et al., Robotics (2009), sec. 8.3; of the "
        "setpoint: MuJoCo's filtered activation (timeconst)"
    )
    parameters = (
        Parameter(
            "time_constant", "time", 0.0, 0.0, 0.5, (0.01, 0.03, 0.08),
            meaning="lag time constant",
        ),
        Parameter(
            "of_setpoint", "one", None, 0.0, 1.0, (0.0, 1.0), choice=True,
            meaning="signal with the lag",
            choices=("lag of the effort", "lag of the setpoint"),
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "command_delay": "record steps: a lag responds at once, a delay leaves a dead time",
        "armature": "repeat the recording with two payloads: a lag does not depend on the payload",
    }

    def initial_filters(
        self, world: World, values: Values
    ) -> tuple[_FirstOrderLag, _FirstOrderLag]:
        # For an effort drive command and effort are one signal: its lag counts as the effort's.
        of_setpoint = values["of_setpoint"] * (world.servo != "effort")
        of_effort = 1.0 - values["of_setpoint"]
        each = (values["time_constant"] * share for share in (of_setpoint, of_effort))
        before, after = (_FirstOrderLag.of(lag, world.timestep) for lag in each)
        return before, after


@dataclass(slots=True)
class _FirstOrderLag:
    """A first-order lag, exact for an input that is constant over the step.

    Attributes:
        decay: (rows, joints) share of the difference to the input that remains after a step.
        mean_decay: the mean of that share over the step.
        is_active: whether any time constant is positive; otherwise the input passes unchanged.
        output: (rows, joints) output.
    """

    decay: FloatArray
    mean_decay: FloatArray
    is_active: bool
    output: FloatArray | None = None

    @classmethod
    def of(cls, lag: FloatArray, timestep: float) -> _FirstOrderLag:
        """The lag with (rows, joints) time constants, s."""
        steps = timestep / np.maximum(lag, 1e-9)
        mean_decay = np.where(lag > 0.0, -np.expm1(-steps) / steps, 0.0)
        return cls(np.exp(-steps), mean_decay, bool(lag.any()))

    def mean(self, filter_input: FloatArray) -> FloatArray:
        """(rows, joints) mean output over the next step for the input ``filter_input``."""
        if not self.is_active:
            return filter_input
        difference = (filter_input if self.output is None else self.output) - filter_input
        self.output = filter_input + self.decay * difference
        mean: FloatArray = filter_input + self.mean_decay * difference
        return mean

    def hold(self, filter_input: FloatArray, steps: FloatArray) -> None:
        """Hold the (rows, joints) input for a number of steps, fractions included."""
        difference = (filter_input if self.output is None else self.output) - filter_input
        self.output = filter_input + self.decay**steps * difference


_INVERSE_RATES = tuple(0.15 * 1.25**k for k in range(16))


class RateLimit(_FilterEffect):
    """A limit on how fast the setpoint (profile generator, firmware) or the effort may change."""

    id = "rate_limit"
    family = "actuation"
    is_limit = True
    law = (
        "of_effort 0: |d(setpoint)/dt| <= rate; "
        "of_effort 1 (servos): |d(delivered)/dt| <= effort_rate"
    )
    source = "slew-rate limit; Klein, Rundqwist, J. Guidance 1996"
    parameters = (
        # Absent at infinity: the parameter is the reciprocal of the rate.
        Parameter(
            "inverse_rate", "one", 0.0, 0.0, 60.0, _INVERSE_RATES, "slowness",
            ("rate", "command_rate"), under=("of_effort", (0.0,)),
            meaning="rate limit of the setpoint",
        ),
        Parameter(
            "inverse_effort_rate", "one", 0.0, 0.0, 60.0, _INVERSE_RATES, "effort_slowness",
            ("effort_rate", "effort_rate"), under=("of_effort", (1.0,)),
            meaning="rate limit of the effort",
        ),
        Parameter(
            "of_effort", "one", None, 0.0, 1.0, (0.0, 1.0), choice=True,
            meaning="limited signal", choices=("limits the setpoint", "limits the effort"),
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "torque_saturation": "repeat the recording with a payload: a rate limit does not depend on "
        "the load",
        "command_delay": "record steps of two sizes: a delay is the same for both",
        "actuator_lag": "record steps of two sizes: the response of a lag scales with the step, "
        "that of a rate limit does not",
    }

    def initial_filters(self, world: World, values: Values) -> tuple[_RateLimiter, _RateLimiter]:
        # For an effort drive command and effort are one signal: one limit for both.
        of_effort = values["inverse_effort_rate"] * (world.servo != "effort")
        before = _RateLimiter.of(values["inverse_rate"], world.timestep)
        return before, _RateLimiter.of(of_effort, world.timestep)


@dataclass(slots=True)
class _RateLimiter:
    """A rate limit, exact for an input that is constant over the step.

    Attributes:
        max_change: (rows, joints) largest change in a step.
        is_active: whether any limit exists; otherwise the input passes unchanged.
        output: (rows, joints) output.
    """

    max_change: FloatArray
    is_active: bool
    output: FloatArray | None = None

    @classmethod
    def of(cls, inverse_rate: FloatArray, timestep: float) -> _RateLimiter:
        """The limit with (rows, joints) reciprocal rates."""
        # Finite without a limit, so that no time at all is no change, and exact there.
        return cls(timestep / np.maximum(inverse_rate, 1e-200), bool(inverse_rate.any()))

    def mean(self, filter_input: FloatArray) -> FloatArray:
        """(rows, joints) mean output over the next step for the input ``filter_input``."""
        if not self.is_active:
            return filter_input
        output = filter_input if self.output is None else self.output
        moved = fast_clip(filter_input - output, -self.max_change, self.max_change)
        self.output = output + moved
        mean: FloatArray = output + moved * (1.0 - np.abs(moved) / (2.0 * self.max_change))
        return mean

    def hold(self, filter_input: FloatArray, steps: FloatArray) -> None:
        """Hold the (rows, joints) input for a number of steps, fractions included."""
        output = filter_input if self.output is None else self.output
        max_change = steps * self.max_change
        self.output = output + fast_clip(filter_input - output, -max_change, max_change)


class TorqueConstant(Effect):
    """The drive delivers more or less torque per ampere than the model assumes."""

    id = "torque_constant"
    family = "actuation"
    stage = "drive"
    # A servo has gains instead, of which it is a special case.
    basic_modes = ("effort",)
    nearly_linear = True
    law = "delivered = (1 + relative_error) drive"
    source = "Nm per A; Siciliano et al., Robotics (2009), sec. 5.2"
    parameters = (
        # Motor constants differ by 10 % from part to part, and hot magnets lose 10 to 20 %.
        Parameter(
            "relative_error", "one", 0.0, -0.8, 1.5, (0.1,), meaning="torque constant",
            relation="relative", usual=0.15,
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "controller_gain": "command a feed-forward effort: a servo gain does not act on it",
        "inertial_parameters": "add a known payload: only a wrong torque constant misjudges its "
        "weight",
        "effort_scale": "compare the motion: an effort sensor does not change it",
    }

    def gains(self, world: World, values: Values) -> None:
        factor = 1.0 + values["relative_error"]
        world.gain = world.gain * factor
        world.stiffness = world.stiffness * factor
        world.damping = world.damping * factor
        world.offset = world.offset * factor
        world.lower = world.lower * factor
        world.upper = world.upper * factor


class TorqueSaturation(Effect):
    """The drive's effort is limited, by its current limit for example."""

    id = "torque_saturation"
    family = "actuation"
    stage = "drive"
    is_limit = True
    law = "|drive| <= limit"
    source = "peak current; Siciliano et al., Robotics (2009), sec. 5.2"
    parameters = (
        # Absent at infinity: the parameter is the reciprocal of the limit.
        Parameter(
            "inverse_limit",
            "one",
            0.0,
            0.0,
            30.0,
            tuple(0.7 * 1.3**k for k in range(14)),
            "inverse_effort",
            ("limit", "effort"),
            meaning="effort limit",
        ),
    )
    confused_with: ClassVar = {
        "torque_speed_limit": "stall the joint against a stop: at zero speed only saturation "
        "limits the effort",
        "rate_limit": "repeat the recording with a payload: a rate limit does not depend on the "
        "load",
        "controller_gain": "record steps of two sizes: the response of a gain scales with the step",
    }

    def gains(self, world: World, values: Values) -> None:
        limit = 1.0 / np.maximum(values["inverse_limit"], 1e-12)
        world.lower = np.maximum(world.lower, -limit)
        world.upper = np.minimum(world.upper, limit)


class TorqueSpeedLimit(Effect):
    """The available effort falls with speed, because back-EMF uses up the supply voltage."""

    id = "torque_speed_limit"
    family = "actuation"
    stage = "drive"
    is_limit = True
    law = "drive sign(v) <= stall (1 - |v| / no_load_speed)"
    source = "DC motor curve; Hughes, Drury, Electric Motors and Drives (2019), ch. 3"
    parameters = (
        Parameter(
            "inverse_no_load_speed",
            "one",
            0.0,
            0.0,
            5.0,
            tuple(0.15 * 1.5**k for k in range(6)),
            "inverse_velocity",
            ("no_load_speed", "velocity"),
            meaning="no-load speed",
        ),
        Parameter(
            "stall", "effort", None, 0.05, 20.0, (0.2, 0.35, 0.6, 1.0, 1.5, 2.5, 4.0, 7.0),
            "effort", meaning="stall effort",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "torque_saturation": "stall the joint against a stop: at zero speed only saturation limits "
        "the effort",
        "viscous_friction": "record a slow move under load: the limit acts at high effort and "
        "speed only",
    }
    generalizes = frozenset({"torque_saturation"})

    def special_cases(self, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        return {"torque_saturation": {"inverse_limit": 1.0 / max(values["stall"], 1e-12)}}

    def servo(self, world: World, values: Values) -> None:
        inverse = values["inverse_no_load_speed"]
        stall = world.state.get(self.id)
        if stall is None:
            stall = world.state[self.id] = np.where(inverse > 0.0, values["stall"], np.inf)
        speed_ratio = inverse * world.motor_velocity
        world.upper = np.minimum(world.upper, stall * fast_clip(1.0 - speed_ratio, 0.0, 1.0))
        world.lower = np.maximum(world.lower, -stall * fast_clip(1.0 + speed_ratio, 0.0, 1.0))


class DeadZone(Effect):
    """The servo ignores small errors or delivers no small efforts; an effort drive ignores small
    commands.
    """

    id = "dead_zone"
    family = "actuation"
    stage = "drive"
    law = (
        "of_effort 0: error -> sign(error) max(|error| - width, 0), for an effort drive its "
        "command; of_effort 1 (servos): effort -> sign(effort) max(|effort| - gain width, 0)"
    )
    source = "Tao, Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities"
    parameters = (
        Parameter(
            "width", "command", 0.0, 0.0, 1.0, (0.01, 0.03, 0.1), "command",
            meaning="dead-zone half-width",
        ),
        Parameter(
            "of_effort", "one", None, 0.0, 1.0, (0.0, 1.0), choice=True,
            meaning="signal with the dead zone",
            choices=("dead zone of the error", "dead zone of the effort"),
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "coulomb_friction": "switch the drive off at rest: friction holds the joint, a dead zone "
        "does not",
        "backlash": "move the link by hand with the motor held: only backlash gives free play",
    }

    def servo(self, world: World, values: Values) -> None:
        width, of_position, _ = self._widths(world, values)
        if width is None:
            return
        error = world.setpoint - np.where(of_position, world.motor_position, 0.0)
        world.setpoint = world.setpoint - fast_clip(error, -width, width)

    def drive(self, world: World, values: Values) -> None:
        _, _, effort_width = self._widths(world, values)
        if effort_width is not None:
            world.delivered = world.delivered - fast_clip(
                world.delivered, -effort_width, effort_width
            )

    def _widths(
        self, world: World, values: Values
    ) -> tuple[FloatArray | None, NDArray[np.bool_], FloatArray | None]:
        """(rows, joints) width of the error's dead zone, whether the servo controls position, and
        width of the effort's dead zone; None where there is none.
        """
        found: tuple[FloatArray | None, NDArray[np.bool_], FloatArray | None]
        if self.id not in world.state:
            # For an effort drive command and effort are one signal: one dead zone for both.
            of_effort = values["of_effort"] * (world.servo != "effort")
            width = values["width"] * (1.0 - values["of_effort"])
            effort_width = world.gain * values["width"] * of_effort
            world.state[self.id] = (
                width if width.any() else None, world.servo == "position",
                effort_width if effort_width.any() else None,
            )  # fmt: skip
        found = world.state[self.id]
        return found


class Cogging(Effect):
    """Effort that varies periodically with the rotor angle: torque ripple of magnets and slots."""

    id = "cogging"
    family = "actuation"
    periodic = True
    law = (
        "effort = sine sin(harmonic q) + cosine cos(harmonic q); "
        "harmonic: periods per turn on a hinge"
    )
    source = "Holtz, Springob, IEEE Trans. Ind. Electron. 43 (1996): torque ripple"
    parameters = (
        Parameter("sine", "effort", 0.0, -2.0, 2.0, (0.1,), "effort", meaning="sine amplitude"),
        Parameter("cosine", "effort", 0.0, -2.0, 2.0, (0.1,), "effort", meaning="cosine amplitude"),
        Parameter(
            "harmonic",
            "wavenumber",
            None,
            2.0,
            200.0,
            tuple(float(k) for k in (3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 20, 24)),
            "one",
            meaning="wavenumber",
        ),
    )
    confused_with: ClassVar = {
        "position_dependent_friction": "repeat the motion in both directions: friction changes its "
        "sign",
        "joint_spring": "move through half a turn: cogging repeats, a spring does not",
    }

    def force(self, world: World, values: Values) -> None:
        angle = values["harmonic"] * world.motor_position
        world.push_motor(values["sine"] * np.sin(angle) + values["cosine"] * np.cos(angle))


class ControllerGain(Effect):
    """The servo's stiffness or damping differs from the model's."""

    id = "controller_gain"
    family = "actuation"
    stage = "drive"
    basic_modes = ("position", "velocity")
    nearly_linear = True
    law = "effort = (1 + stiffness_error) kp (setpoint - q) - (1 + damping_error) kv v"
    source = "PD law; Siciliano et al., Robotics (2009), sec. 8.5"
    parameters = (
        # A vendor's model may have a gain 50 times the firmware's; firmware is tuned tenfold.
        Parameter(
            "stiffness_error", "one", 0.0, -0.998, 9.0, (0.1,), meaning="servo stiffness",
            relation="relative",
        ),
        Parameter(
            "damping_error", "one", 0.0, -1.0, 4.0, (0.1,), meaning="servo damping",
            relation="relative",
        ),
    )  # fmt: skip
    modes = ("position", "velocity")
    confused_with: ClassVar = {
        "torque_constant": "command a feed-forward effort, or stall the joint: a gain does not "
        "change the effort limit",
        "viscous_friction": "move the joint with the drive off: only friction remains",
        "joint_spring": "move the joint with the drive off: only a spring remains",
    }
    # Servo damping without stiffness acts like viscous friction.
    generalizes = frozenset({"torque_constant", "viscous_friction"})

    def acts_on_servo(self, stiffness: float, damping: float) -> NDArray[np.bool_]:
        return np.array([stiffness != 0.0, damping != 0.0])

    def special_cases(self, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        return {"torque_constant": {"relative_error": values["stiffness_error"]}}

    def with_other(
        self, own: Mapping[str, float], effect: str, other: Mapping[str, float]
    ) -> Mapping[str, float]:
        """A torque constant multiplies both gains."""
        if effect != "torque_constant":
            return super().with_other(own, effect, other)
        factor = 1.0 + other["relative_error"]
        return {name: (1.0 + value) * factor - 1.0 for name, value in own.items()}

    def coordinates(self, parameters: FloatArray) -> FloatArray:
        """Logarithm of the stiffness: a servo's deflection is proportional to its reciprocal."""
        stiffness, damping = parameters
        return np.array([np.log1p(stiffness), damping])

    def from_coordinates(self, coordinates: FloatArray) -> FloatArray:
        """The inverse."""
        stiffness, damping = coordinates
        return np.array([np.expm1(stiffness), damping])

    def gains(self, world: World, values: Values) -> None:
        stiffness, damping = 1.0 + values["stiffness_error"], 1.0 + values["damping_error"]
        world.gain = world.gain * np.where(world.servo == "velocity", damping, stiffness)
        world.stiffness = world.stiffness * stiffness
        world.damping = world.damping * damping

    def pose_shift(
        self, parameter: str, value: float, unit: str, servo_stiffness: float | None
    ) -> PoseShift | str | None:
        if parameter not in ("", "stiffness_error") or value <= -1.0:
            return None
        if servo_stiffness is None:
            return "no position servo drives this joint, so its gain holds no load"
        return PoseShift(1.0 / (servo_stiffness * (1.0 + value) ** 2), "load")
