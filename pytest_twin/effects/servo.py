"""Servo effects: what a digital servo does besides its proportional and derivative terms.

Each is a shift of the setpoint in the control law, so that the drive's limits act on the sum. The
engine integrates the servo's damping implicitly. That leaves an error proportional to the step,
which the diagnosis extrapolates away with the step's other errors (Richardson).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import Effect, Parameter, Values, World
from pytest_twin.effects.fast_clip import fast_clip

_SERVOS = ("position", "velocity")


def _setpoint_shift(effort: FloatArray, world: World) -> FloatArray:
    """Shift of the setpoint that adds an effort to the control law; 0 without a drive."""
    driven = world.gain != 0.0
    shift: FloatArray = np.where(driven, effort / np.where(driven, world.gain, 1.0), 0.0)
    return shift


class VelocityFilter(Effect):
    """The servo's derivative term acts on a low-pass filtered velocity."""

    id = "velocity_filter"
    family = "actuation"
    law = (
        "effort = gain setpoint - stiffness q - damping filtered; "
        "time_constant d(filtered)/dt = v - filtered"
    )
    source = "derivative filter; Astrom, Murray, Feedback Systems (2008), sec. 10.5"
    parameters = (
        Parameter(
            "time_constant", "time", 0.0, 0.0, 0.2, (0.005, 0.02),
            meaning="time constant of the velocity filter",
        ),
    )  # fmt: skip
    modes = _SERVOS
    remembers = True
    confused_with: ClassVar = {
        "controller_gain": "record slow and fast motions: a filter reduces the damping of fast "
        "motions only",
        "armature": "move the joint with the drive off: only armature remains",
        "actuator_lag": "command a step with the joint held: only a lag of the effort delays the "
        "rise",
        "control_period": "record a chirp: a filter delays the damping only, a control period the "
        "stiffness too",
    }

    def servo(self, world: World, values: Values) -> None:
        lag = values["time_constant"]
        now = world.motor_velocity
        known: tuple[FloatArray, FloatArray] | None = world.state.get(self.id)
        if known is None:
            filtered = now
        else:
            # Exact for a velocity that changes linearly over the step.
            before, filtered = known
            behind = (now - before) * lag / world.timestep
            keep = np.exp(-world.timestep / np.maximum(lag, 1e-9))
            filtered = now - behind + (filtered - before + behind) * keep
        world.state[self.id] = (now.copy(), filtered)
        missing = np.where(lag > 0.0, world.damping * (now - filtered), 0.0)
        world.setpoint = world.setpoint + _setpoint_shift(missing, world)


class VelocityFeedforward(Effect):
    """The servo adds an effort proportional to the rate of its setpoint."""

    id = "velocity_feedforward"
    family = "actuation"
    law = "effort = gain (setpoint - q) - damping v + feedforward d(setpoint)/dt"
    source = (
        "Feedforward 1st Gain, ROBOTIS e-Manual, X series; Siciliano et al., Robotics (2009), "
        "sec. 8.3"
    )
    parameters = (
        Parameter(
            "feedforward", "damping", 0.0, -5.0, 50.0, (0.2,), "damping",
            meaning="velocity feed-forward gain",
        ),
    )  # fmt: skip
    modes = ("position",)
    remembers = True
    confused_with: ClassVar = {
        "controller_gain": "push the joint at a constant setpoint: a feed-forward does not change "
        "its damping",
        "viscous_friction": "push the joint at a constant setpoint: a feed-forward does not change "
        "its damping",
        "command_delay": "command a ramp from rest: a delay leaves a dead time, a feed-forward "
        "acts at once",
    }

    def command(self, world: World, values: Values) -> None:
        before = world.state.get(self.id, (world.setpoint,))[0]
        rate = (world.setpoint - before) / world.timestep
        world.state[self.id] = (world.setpoint.copy(), rate)

    def servo(self, world: World, values: Values) -> None:
        rate = world.state[self.id][1]
        world.setpoint = world.setpoint + _setpoint_shift(values["feedforward"] * rate, world)


class IntegralGain(Effect):
    """The servo has an integral term; it stops where the drive is at its limit.

    Before a recording begins the term has settled: it carries the load of the joint at rest.
    """

    id = "integral_gain"
    family = "actuation"
    law = (
        "effort = gain (error + integral) - damping v; "
        "integral_time d(integral)/dt = error, 0 while the drive is at its limit; "
        "error: setpoint - q of a position servo, setpoint - v of a velocity servo"
    )
    source = "PID with conditional integration; Astrom, Murray, Feedback Systems (2008), sec. 10.4"
    parameters = (
        # Absent at infinity: the parameter is the reciprocal of the time.
        Parameter(
            "inverse_integral_time", "one", 0.0, 0.0, 100.0, (0.7, 4.0), "one",
            ("integral_time", "time"), meaning="integral time (gain divided by integral gain)",
        ),
    )  # fmt: skip
    modes = _SERVOS
    remembers = True
    reads_load = True
    confused_with: ClassVar = {
        "controller_gain": "hold a load for a second: only an integral term removes the error at "
        "rest",
        "coulomb_friction": "hold a load for a second: only an integral term removes the error at "
        "rest",
        "payload": "hold a load for a second: only an integral term removes the error at rest",
    }

    def servo(self, world: World, values: Values) -> None:
        rate = values["inverse_integral_time"]
        state = np.where(world.servo == "velocity", world.motor_velocity, world.motor_position)
        error = world.setpoint - state
        integral = world.state.get(self.id)
        if integral is None:
            at_rest = world.control_effort(
                world.motor_position, np.zeros_like(world.motor_velocity)
            )
            settled = _setpoint_shift(world.load - at_rest, world)
            # Later in a recording the joint moves: its effort does not show the term.
            begins = world.time[:, None] <= world.timestep
            integral = np.where(begins & (rate > 0.0), settled, 0.0)
        effort = (
            world.control_effort(world.motor_position, world.motor_velocity) + world.gain * integral
        )
        saturated = ((effort > world.upper) & (error > 0.0)) | (
            (effort < world.lower) & (error < 0.0)
        )
        grown = integral + np.where(saturated, 0.0, rate * error * world.timestep)
        world.state[self.id] = grown
        world.setpoint = world.setpoint + np.where(rate > 0.0, 0.5 * (integral + grown), 0.0)


class ControlPeriod(Effect):
    """A sampled servo: it reads its encoder once per period and holds its effort until the next.

    The velocity is the difference of two readings divided by the period. When a recording begins
    within a period is unknown. The law is therefore the mean over all phases: a recording shows
    the delay that sampling adds, not the steps of the effort.
    """

    id = "control_period"
    family = "actuation"
    law = (
        "effort(t) = mean over s of gain setpoint(s) - stiffness q(s) "
        "- damping (q(s) - q(s - period)) / period; "
        "t - (1 + computing_delay) period <= s <= t - computing_delay period"
    )
    source = "zero-order hold; Franklin, Powell, Workman, Digital Control (1998), ch. 4 and 5"
    parameters = (
        Parameter("period", "time", 0.0, 0.0, 0.04, (0.005, 0.015), meaning="control period"),
        Parameter(
            "computing_delay", "one", None, 0.0, 2.0, (0.0, 1.0),
            meaning="computing delay in control periods",
        ),
    )  # fmt: skip
    modes = _SERVOS
    remembers = True
    # It samples the setpoint after all other effects have changed it.
    hook_order = 9
    confused_with: ClassVar = {
        "command_delay": "push the robot by hand: a control period reduces the damping, a delay of "
        "the command does not",
        "controller_gain": "record slow and fast motions: a control period reduces the damping of "
        "fast motions only",
        "actuator_lag": "log the effort at 1 kHz or more: a control period shows steps, a lag is "
        "smooth",
        "velocity_filter": "record a chirp: a control period delays the stiffness too",
    }

    def servo(self, world: World, values: Values) -> None:
        past: _SignalIntegrals | None = world.state.get(self.id)
        if past is None:
            acts = (values["period"] > 0.0) & (world.gain != 0.0)
            period = np.where(acts, values["period"], 1.0)
            delay = values["computing_delay"] * period
            past = world.state[self.id] = _SignalIntegrals.initial(world, acts, period, delay)
        past.add(world)
        period = past.period
        now, one, two = past.position()
        until, before = past.setpoint()
        position, change = now - one, now - 2.0 * one + two
        effort = (
            world.offset
            + (
                world.gain * (until - before)
                - world.stiffness * position
                - world.damping * change / period
            )
            / period
        )
        effort = fast_clip(effort, world.lower, world.upper)
        # The control law at the present state asks for the effort that is held.
        more = effort - world.control_effort(world.motor_position, world.motor_velocity)
        world.setpoint = np.where(
            past.acts, world.setpoint + _setpoint_shift(more, world), world.setpoint
        )


@dataclass(slots=True)
class _SignalIntegrals:
    """Integrals of positions and setpoints over time, for the last steps.

    Attributes:
        acts: (rows, joints) whether the servo is sampled.
        period: (rows, joints) sample period, s.
        timestep: time step, s.
        count: number of steps so far.
        positions, setpoints: (steps, rows * joints) ring buffers; step ``k`` is at ``k % steps``.
        position_integrals, setpoint_integrals: integrals up to the start of each step.
        position_ages, setpoint_ages: ages of the last three and the last two samples, latest first.
    """

    acts: NDArray[np.bool_]
    period: FloatArray
    timestep: float
    count: int
    positions: FloatArray
    setpoints: FloatArray
    position_integrals: FloatArray
    setpoint_integrals: FloatArray
    position_ages: _SampleAge
    setpoint_ages: _SampleAge

    @classmethod
    def initial(
        cls, world: World, acts: NDArray[np.bool_], period: FloatArray, delay: FloatArray
    ) -> _SignalIntegrals:
        """The past before a simulation: constant velocity and constant setpoint."""
        step = world.timestep
        samples = np.array([delay, delay + period, delay + 2.0 * period])
        longest = float(np.where(acts, samples[2], 0.0).max())
        steps = int(np.ceil(longest / step)) + 3
        ago = step * (steps - np.arange(steps, dtype=np.float64))[:, None]
        position, velocity = world.motor_position.ravel(), world.motor_velocity.ravel()
        # A servo that is not sampled reads the present state.
        samples = np.where(acts, samples, 0.0)
        # The engine holds the setpoint of a step from half a step before to half a step after.
        back = np.maximum(samples[:2] - 0.5 * step, -0.5 * step)
        return cls(
            acts, period, step, 0, position - ago * velocity,
            np.tile(world.setpoint.ravel(), (steps, 1)),
            0.5 * ago**2 * velocity - ago * position, -ago * world.setpoint.ravel(),
            _SampleAge.of(samples, step), _SampleAge.of(back, step),
        )  # fmt: skip

    def add(self, world: World) -> None:
        """Add the present step."""
        steps, step = len(self.positions), self.timestep
        at, last = self.count % steps, (self.count - 1) % steps
        position = world.motor_position.ravel()
        self.position_integrals[at] = self.position_integrals[last] + 0.5 * step * (
            self.positions[last] + position
        )
        self.setpoint_integrals[at] = self.setpoint_integrals[last] + step * self.setpoints[last]
        self.positions[at], self.setpoints[at] = position, world.setpoint.ravel()
        self.count += 1

    def position(self) -> FloatArray:
        """(3, rows, joints) integral of the position until each sample."""
        back = self.position_ages
        at = back.index_before(self.count, len(self.positions))
        before = self.positions.take(at)
        after = back.index_after(self.count, len(self.positions))
        rise = self.positions.take(after) - before
        inside = before + rise * back.half_share
        found: FloatArray = (self.position_integrals.take(at) + inside * back.since).reshape(
            back.shape
        )
        return found

    def setpoint(self) -> FloatArray:
        """(2, rows, joints) integral of the setpoint until each of the two latest samples."""
        back = self.setpoint_ages
        at = back.index_before(self.count, len(self.setpoints))
        found: FloatArray = self.setpoint_integrals.take(at) + self.setpoints.take(at) * back.since
        return found.reshape(back.shape)


@dataclass(frozen=True, slots=True)
class _SampleAge:
    """Age of samples relative to the present step.

    Attributes:
        shape: (samples, rows, joints).
        before: (samples, rows * joints) index of the step before each sample, relative to that of
            the present step, into (steps, columns) without their end: it may be negative.
        after: the same of the step after each sample.
        since: (samples, rows * joints) time from the step before to the sample, s.
        half_share: half of ``since``, in steps.
    """

    shape: tuple[int, ...]
    before: NDArray[np.int64]
    after: NDArray[np.int64]
    since: FloatArray
    half_share: FloatArray

    @classmethod
    def of(cls, ago: FloatArray, step: float) -> _SampleAge:
        """From (samples, rows, joints) ages in s; negative ones are after the present step."""
        flat = ago.reshape(len(ago), -1)
        whole = np.maximum(np.ceil(flat / step), 0.0).astype(np.int64)
        since = whole * step - flat
        column = np.arange(flat.shape[1])
        before, after = (column - back * len(column) for back in (whole, np.maximum(whole - 1, 0)))
        return cls(ago.shape, before, after, since, 0.5 * since / step)

    def index_before(self, count: int, steps: int) -> NDArray[np.int64]:
        """Indices, into (steps, columns), of the step before each sample.

        Negative ones count from the end, as in a ring.
        """
        found: NDArray[np.int64] = self.before + (count - 1) % steps * self.before.shape[1]
        return found

    def index_after(self, count: int, steps: int) -> NDArray[np.int64]:
        """Indices of the step after each sample."""
        found: NDArray[np.int64] = self.after + (count - 1) % steps * self.after.shape[1]
        return found
