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
from pytest_twin.effects.within import within

_SERVOS = ("position", "velocity")


def _per_gain(effort: FloatArray, world: World) -> FloatArray:
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
        world.setpoint = world.setpoint + _per_gain(missing, world)


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
        world.setpoint = world.setpoint + _per_gain(values["feedforward"] * rate, world)


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
            at_rest = world.asked(world.motor_position, np.zeros_like(world.motor_velocity))
            settled = _per_gain(world.load - at_rest, world)
            # Later in a recording the joint moves: its effort does not show the term.
            begins = world.time[:, None] <= world.timestep
            integral = np.where(begins & (rate > 0.0), settled, 0.0)
        effort = world.asked(world.motor_position, world.motor_velocity) + world.gain * integral
        saturated = ((effort > world.upper) & (error > 0.0)) | (
            (effort < world.lower) & (error < 0.0)
        )
        grown = integral + np.where(saturated, 0.0, rate * error * world.timestep)
        world.state[self.id] = grown
        world.setpoint = world.setpoint + np.where(rate > 0.0, 0.5 * (integral + grown), 0.0)


class ControlPeriod(Effect):
    """A sampled servo: it reads its encoder once per period and holds its effort until the next.

    The velocity is the difference of two readings divided by the period. Periods are counted from
    the start of the recording; the true phase is unknown and matters by half a period at most.
    """

    id = "control_period"
    family = "actuation"
    law = (
        "effort(t) = gain setpoint(s) - stiffness q(s) - damping (q(s) - q(s - period)) / period; "
        "s = period floor(t / period - computing_delay)"
    )
    source = "zero-order hold; Franklin, Powell, Workman, Digital Control (1998), ch. 4 and 5"
    parameters = (
        Parameter(
            "period", "time", 0.0, 0.0, 0.04, (0.005, 0.015), meaning="control period"
        ),
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
        "command_delay": "push the robot by hand: a control period takes damping away, a delay of "
        "the command does not",
        "controller_gain": "record slow and fast motions: a control period takes damping away from "
        "fast motions only",
        "actuator_lag": "log the effort at 1 kHz or more: a control period shows steps, a lag is "
        "smooth",
        "velocity_filter": "record a chirp: a control period delays the stiffness too",
    }

    def servo(self, world: World, values: Values) -> None:
        period = values["period"]
        acts = (period > 0.0) & (world.gain != 0.0)
        period = np.where(acts, period, 1.0)
        delay = values["computing_delay"] * period
        past: _Past | None = world.state.get(self.id)
        if past is None:
            longest = float(np.where(acts, delay + 2.0 * period, 0.0).max())
            past = world.state[self.id] = _Past.at(world, longest)
        past.add(world)
        first, share, rest = _samples(world.time[:, None], world.timestep, period, delay)
        effort = share * self._effort(world, past, first, period)
        effort += (1.0 - share) * self._effort(world, past, rest, period)
        # The control law at the present state asks for the effort that is held.
        more = effort - world.asked(world.motor_position, world.motor_velocity)
        world.setpoint = np.where(acts, world.setpoint + _per_gain(more, world), world.setpoint)

    @staticmethod
    def _effort(world: World, past: _Past, ago: FloatArray, period: FloatArray) -> FloatArray:
        """Effort of the sample that was taken (rows, joints) ``ago``, s, within the limits."""
        position, setpoint = past.position(ago), past.setpoint(ago)
        velocity = (position - past.position(ago + period)) / period
        effort = (
            world.gain * setpoint - world.stiffness * position - world.damping * velocity
            + world.offset
        )  # fmt: skip
        return within(effort, world.lower, world.upper)


def _samples(
    time: FloatArray, step: float, period: FloatArray, delay: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Samples that a sampled servo uses in the step around ``time``.

    The engine evaluates the control law once a step, at the state of ``time``. A step therefore
    counts as the time from half a step before to half a step after. Without a period the sampled
    servo then is the engine's.

    Returns:
        How long ago the sample in use at the beginning was taken, s; the share of the step that it
        stays in use; and how long ago, on average, the samples of the rest of the step are taken.
    """
    # A rounding error must not move the last sample by a period.
    begin = time - 0.5 * step
    last = np.floor((begin - delay) / period + 1e-9) * period
    until = last + period + delay - begin
    share = np.minimum(until / step, 1.0)
    left = np.maximum(step - until, 0.0)
    whole = np.floor(left / period)
    behind = period * whole * (left - 0.5 * period * (whole + 1.0))
    mean = np.where(left > 0.0, behind / np.maximum(left, 1e-12), 0.0)
    return time - last, share, time - last - period - mean


@dataclass(slots=True)
class _Past:
    """Positions and setpoints of the last steps.

    Attributes:
        steps: how many are kept.
        timestep: s.
        count: steps so far.
        positions, setpoints: (steps, rows, joints), step ``k`` at ``k % steps``.
        velocity: (rows, joints) of the last step.
    """

    steps: int
    timestep: float
    count: int
    positions: FloatArray
    setpoints: FloatArray
    velocity: FloatArray

    @classmethod
    def at(cls, world: World, longest: float) -> _Past:
        """A past of ``longest`` s in which the joints moved evenly."""
        steps = int(np.ceil(longest / world.timestep)) + 3
        # Step -1 is the last one before the present.
        ago = (steps - np.arange(steps, dtype=np.float64))[:, None, None] * world.timestep
        return cls(
            steps, world.timestep, 0, world.motor_position - ago * world.motor_velocity,
            np.tile(world.setpoint, (steps, 1, 1)), world.motor_velocity,
        )  # fmt: skip

    def add(self, world: World) -> None:
        """Add the present step."""
        at = self.count % self.steps
        self.positions[at], self.setpoints[at] = world.motor_position, world.setpoint
        self.velocity = world.motor_velocity.copy()
        self.count += 1

    def position(self, ago: FloatArray) -> FloatArray:
        """(rows, joints) positions so long ago, s; a little ahead if negative."""
        steps = np.maximum(ago / self.timestep, 0.0)
        whole = steps.astype(np.int64)
        here, before = self._of(self.positions, whole), self._of(self.positions, whole + 1)
        ahead: FloatArray = here + (steps - whole) * (before - here)
        return ahead + self.velocity * np.maximum(-ago, 0.0)

    def setpoint(self, ago: FloatArray) -> FloatArray:
        """(rows, joints) setpoints of the nearest steps so long ago, s."""
        steps = np.floor(np.maximum(ago / self.timestep, 0.0) + 0.5)
        return self._of(self.setpoints, steps.astype(np.int64))

    def _of(self, kept: FloatArray, back: NDArray[np.int64]) -> FloatArray:
        at = (self.count - 1 - back) % self.steps
        found: FloatArray = np.take_along_axis(kept, at[None], axis=0)[0]
        return found
