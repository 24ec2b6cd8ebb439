"""Actuation: what the drive makes of its command."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import Effect, Parameter, Values, World
from pytest_twin.effects.within import within


class _Follower(Protocol):
    """Something that what comes in is followed by."""

    acts: bool

    def mean(self, asked: FloatArray) -> FloatArray:
        """(rows, joints) mean over the next step of what follows ``asked``."""

    def live_through(self, asked: FloatArray, steps: FloatArray) -> None:
        """Follow (rows, joints) ``asked`` for so many steps, and fractions of them."""


class _Follows(Effect):
    """The setpoint that a drive's law sees follows its command, or its effort follows its law."""

    remembers = True

    def memories(self, world: World, values: Values) -> tuple[_Follower, _Follower]:
        """Of the setpoint and of the effort, as a motion begins."""
        raise NotImplementedError

    def command(self, world: World, values: Values) -> None:
        world.setpoint = self._followers(world, values)[0].mean(world.setpoint)

    def follow_commands(
        self, world: World, values: Values, commands: Iterable[tuple[FloatArray, FloatArray]]
    ) -> None:
        setpoint, _ = self._followers(world, values)
        if setpoint.acts:
            for command, seconds in commands:
                setpoint.live_through(command, seconds / world.timestep)

    def drive(self, world: World, values: Values) -> None:
        world.delivered = self._followers(world, values)[1].mean(world.delivered)

    def _followers(self, world: World, values: Values) -> tuple[_Follower, _Follower]:
        found: tuple[_Follower, _Follower] | None = world.state.get(self.id)
        if found is None:
            found = world.state[self.id] = self.memories(world, values)
        return found


class ActuatorLag(_Follows):
    """The drive answers with a first-order lag: its effort does, or, behind a smoothed command, the
    setpoint that its law sees.
    """

    id = "actuator_lag"
    family = "actuation"
    law = (
        "time_constant d(delivered)/dt = drive - delivered; with of_setpoint 1, of a servo: "
        "time_constant d(setpoint)/dt = command - setpoint"
    )
    source = (
        "current loop as a first-order lag; Siciliano et al., Robotics (2009), sec. 8.3; of the "
        "setpoint: MuJoCo's filtered activation (timeconst)"
    )
    parameters = (
        Parameter("time_constant", "time", 0.0, 0.0, 0.5, (0.01, 0.03, 0.08)),
        Parameter("of_setpoint", "one", None, 0.0, 1.0, (0.0, 1.0), choice=True),
    )
    confused_with: ClassVar = {
        "command_delay": "steps: a lag rises at once, a delay leaves a dead time",
        "armature": "two payloads: a lag does not depend on what is carried",
    }

    def memories(self, world: World, values: Values) -> tuple[_Lag, _Lag]:
        # What an effort drive is sent is what it gives: its lag is that of the effort.
        of_setpoint = values["of_setpoint"] * (world.servo != "effort")
        of_effort = 1.0 - values["of_setpoint"]
        each = (values["time_constant"] * share for share in (of_setpoint, of_effort))
        before, after = (_Lag.of(lag, world.timestep) for lag in each)
        return before, after


@dataclass(slots=True)
class _Lag:
    """A first-order lag of a step: exact for an input that is held over it.

    Attributes:
        kept: (rows, joints) share of what it is behind that is left at the end of a step.
        mean_kept: that in the mean over the step.
        acts: whether there is a lag anywhere; where there is none, what comes in goes through.
        followed: (rows, joints) where it has come to.
    """

    kept: FloatArray
    mean_kept: FloatArray
    acts: bool
    followed: FloatArray | None = None

    @classmethod
    def of(cls, lag: FloatArray, timestep: float) -> _Lag:
        """Of (rows, joints) time constants, s."""
        steps = timestep / np.maximum(lag, 1e-9)
        return cls(np.exp(-steps), -np.expm1(-steps) / steps, bool(lag.any()))

    def mean(self, asked: FloatArray) -> FloatArray:
        """(rows, joints) mean over the next step of what follows ``asked``."""
        if not self.acts:
            return asked
        behind = (asked if self.followed is None else self.followed) - asked
        self.followed = asked + self.kept * behind
        mean: FloatArray = asked + self.mean_kept * behind
        return mean

    def live_through(self, asked: FloatArray, steps: FloatArray) -> None:
        """Follow (rows, joints) ``asked`` for so many steps, and fractions of them."""
        behind = (asked if self.followed is None else self.followed) - asked
        self.followed = asked + self.kept**steps * behind


_SLOWNESSES = tuple(0.15 * 1.25**k for k in range(16))


class RateLimit(_Follows):
    """The setpoint moves no faster than a profile generator or the firmware allows; or the effort
    of a servo changes no faster than its current loop allows.
    """

    id = "rate_limit"
    family = "actuation"
    law = "|d(setpoint)/dt| <= rate; with of_effort 1, of a servo: |d(delivered)/dt| <= effort_rate"
    source = "slew-rate limit; Klein, Rundqwist, J. Guidance 1996"
    parameters = (
        # Absent at infinity: the parameter is the reciprocal of the rate.
        Parameter(
            "inverse_rate", "one", 0.0, 0.0, 60.0, _SLOWNESSES, "slowness",
            ("rate", "command_rate"), under=("of_effort", (0.0,)),
        ),
        Parameter(
            "inverse_effort_rate", "one", 0.0, 0.0, 60.0, _SLOWNESSES, "effort_slowness",
            ("effort_rate", "effort_rate"), under=("of_effort", (1.0,)),
        ),
        Parameter("of_effort", "one", None, 0.0, 1.0, (0.0, 1.0), choice=True),
    )  # fmt: skip
    confused_with: ClassVar = {
        "torque_saturation": "a load added: a rate limit does not depend on it",
        "command_delay": "steps of two sizes: a delay does not grow with the step",
        "actuator_lag": "steps of two sizes: a lag scales, a rate limit does not",
    }

    def memories(self, world: World, values: Values) -> tuple[_Slew, _Slew]:
        # What an effort drive is sent is what it gives: one limit for both.
        of_effort = values["inverse_effort_rate"] * (world.servo != "effort")
        before = _Slew.of(values["inverse_rate"], world.timestep)
        return before, _Slew.of(of_effort, world.timestep)


@dataclass(slots=True)
class _Slew:
    """A limit of rate, exact for an input that is held over the step.

    Attributes:
        reach: (rows, joints) most that is gone in a step.
        acts: whether there is a limit anywhere; where there is none, what comes in goes through.
        held: (rows, joints) where it has come to.
    """

    reach: FloatArray
    acts: bool
    held: FloatArray | None = None

    @classmethod
    def of(cls, inverse_rate: FloatArray, timestep: float) -> _Slew:
        """Of (rows, joints) reciprocals of rates."""
        return cls(timestep / np.maximum(inverse_rate, 1e-9), bool(inverse_rate.any()))

    def mean(self, asked: FloatArray) -> FloatArray:
        """(rows, joints) mean over the next step of what follows ``asked``."""
        if not self.acts:
            return asked
        held = asked if self.held is None else self.held
        moved = within(asked - held, -self.reach, self.reach)
        self.held = held + moved
        mean: FloatArray = held + moved * (1.0 - np.abs(moved) / (2.0 * self.reach))
        return mean

    def live_through(self, asked: FloatArray, steps: FloatArray) -> None:
        """Follow (rows, joints) ``asked`` for so many steps, and fractions of them."""
        held = asked if self.held is None else self.held
        reach = steps * self.reach
        self.held = held + within(asked - held, -reach, reach)


class TorqueConstant(Effect):
    """The drive gives more or less effort than its current says."""

    id = "torque_constant"
    family = "actuation"
    of_every_drive = True
    law = "delivered = (1 + relative_error) drive"
    source = "Nm per A; Siciliano et al., Robotics (2009), sec. 5.2"
    parameters = (Parameter("relative_error", "one", 0.0, -0.8, 1.5, (0.1,)),)
    confused_with: ClassVar = {
        "controller_gain": "feed-forward effort: a gain does not act on it",
        "inertial_parameters": "a known payload added: only a torque constant misjudges it",
        "effort_scale": "the motion: a sensor does not change it",
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
    """The drive gives no more than its current limit."""

    id = "torque_saturation"
    family = "actuation"
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
        ),
    )
    confused_with: ClassVar = {
        "torque_speed_limit": "a stall against a stop: only there the speed is zero",
        "rate_limit": "a load added: a rate limit does not depend on it",
        "controller_gain": "steps of two sizes: a gain scales",
    }

    def gains(self, world: World, values: Values) -> None:
        limit = 1.0 / np.maximum(values["inverse_limit"], 1e-12)
        world.lower = np.maximum(world.lower, -limit)
        world.upper = np.minimum(world.upper, limit)


class TorqueSpeedLimit(Effect):
    """The available effort falls with speed: the supply's voltage is used up by back-EMF."""

    id = "torque_speed_limit"
    family = "actuation"
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
        ),
        Parameter(
            "stall", "effort", None, 0.05, 20.0, (0.2, 0.35, 0.6, 1.0, 1.5, 2.5, 4.0, 7.0), "effort"
        ),
    )
    confused_with: ClassVar = {
        "torque_saturation": "a stall against a stop",
        "viscous_friction": "a slow move under load: the limit acts at high effort and speed only",
    }
    has_in_it = frozenset({"torque_saturation"})

    def special_cases(self, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        return {"torque_saturation": {"inverse_limit": 1.0 / max(values["stall"], 1e-12)}}

    def servo(self, world: World, values: Values) -> None:
        inverse = values["inverse_no_load_speed"]
        stall = world.state.get(self.id)
        if stall is None:
            stall = world.state[self.id] = np.where(inverse > 0.0, values["stall"], np.inf)
        used = inverse * world.motor_velocity
        world.upper = np.minimum(world.upper, stall * within(1.0 - used, 0.0, 1.0))
        world.lower = np.maximum(world.lower, -stall * within(1.0 + used, 0.0, 1.0))


class DeadZone(Effect):
    """A servo that ignores small errors, or gives no small efforts; an effort drive that ignores
    small commands.
    """

    id = "dead_zone"
    family = "actuation"
    law = (
        "error -> sign(error) max(|error| - width, 0); an effort drive: the same of its command; "
        "with of_effort 1, of a servo: the same of its effort, beyond gain width"
    )
    source = "Tao, Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities"
    parameters = (
        Parameter("width", "command", 0.0, 0.0, 1.0, (0.01, 0.03, 0.1), "command"),
        Parameter("of_effort", "one", None, 0.0, 1.0, (0.0, 1.0), choice=True),
    )
    confused_with: ClassVar = {
        "coulomb_friction": "release at rest: friction holds, a dead zone lets go",
        "backlash": "hold the link by hand: only backlash lets it move freely",
    }

    def servo(self, world: World, values: Values) -> None:
        width, of_position, _ = self._known(world, values)
        if width is None:
            return
        error = world.setpoint - np.where(of_position, world.motor_position, 0.0)
        world.setpoint = world.setpoint - within(error, -width, width)

    def drive(self, world: World, values: Values) -> None:
        _, _, none = self._known(world, values)
        if none is not None:
            world.delivered = world.delivered - within(world.delivered, -none, none)

    def _known(
        self, world: World, values: Values
    ) -> tuple[FloatArray | None, NDArray[np.bool_], FloatArray | None]:
        """(rows, joints) width of errors that are ignored, whether a servo is of position, and
        efforts that are not given; None where there are none.
        """
        found: tuple[FloatArray | None, NDArray[np.bool_], FloatArray | None]
        if self.id not in world.state:
            # What an effort drive gives is its command: one dead zone for both.
            of_effort = values["of_effort"] * (world.servo != "effort")
            width = values["width"] * (1.0 - values["of_effort"])
            none = world.gain * values["width"] * of_effort
            world.state[self.id] = (
                width if width.any() else None, world.servo == "position",
                none if none.any() else None,
            )  # fmt: skip
        found = world.state[self.id]
        return found


class Cogging(Effect):
    """Effort that varies with the rotor's angle: teeth that prefer the magnets."""

    id = "cogging"
    family = "actuation"
    law = "effort = sine sin(harmonic q) + cosine cos(harmonic q)"
    source = "Holtz, Springob, IEEE Trans. Ind. Electron. 43 (1996): torque ripple"
    of_position = True
    parameters = (
        Parameter("sine", "effort", 0.0, -2.0, 2.0, (0.1,), "effort"),
        Parameter("cosine", "effort", 0.0, -2.0, 2.0, (0.1,), "effort"),
        Parameter(
            "harmonic",
            "wavenumber",
            None,
            2.0,
            200.0,
            tuple(float(k) for k in (3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 20, 24)),
            "one",
        ),
    )
    confused_with: ClassVar = {
        "position_dependent_friction": "both directions: friction changes its sign",
        "joint_spring": "half a turn: cogging repeats",
    }

    def force(self, world: World, values: Values) -> None:
        angle = values["harmonic"] * world.motor_position
        world.push_motor(values["sine"] * np.sin(angle) + values["cosine"] * np.cos(angle))


class ControllerGain(Effect):
    """The servo's stiffness and damping are not those of the model."""

    id = "controller_gain"
    family = "actuation"
    law = "effort = (1 + stiffness_error) kp (setpoint - q) - (1 + damping_error) kv v"
    source = "PD law; Siciliano et al., Robotics (2009), sec. 8.5"
    parameters = (
        # A vendor's model may have a gain that is fifty times what the firmware holds.
        Parameter("stiffness_error", "one", 0.0, -0.998, 4.0, (0.1,)),
        Parameter("damping_error", "one", 0.0, -1.0, 4.0, (0.1,)),
    )
    modes = ("position", "velocity")
    confused_with: ClassVar = {
        "torque_constant": "feed-forward effort, or a stall: a gain leaves the limit where it is",
        "viscous_friction": "the drive off: only friction remains",
        "joint_spring": "the drive off: only a spring pulls",
    }
    # Damping alone is a brake.
    has_in_it = frozenset({"torque_constant", "viscous_friction"})

    def special_cases(self, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        return {"torque_constant": {"relative_error": values["stiffness_error"]}}

    def with_other(
        self, own: Mapping[str, float], effect: str, other: Mapping[str, float]
    ) -> Mapping[str, float]:
        """A drive's constant multiplies both gains."""
        if effect != "torque_constant":
            return super().with_other(own, effect, other)
        factor = 1.0 + other["relative_error"]
        return {name: (1.0 + value) * factor - 1.0 for name, value in own.items()}

    def coordinates(self, parameters: FloatArray) -> FloatArray:
        """A softer servo gives way in proportion to the reciprocal of its stiffness."""
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
