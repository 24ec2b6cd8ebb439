"""What is simulated, and what a simulation's sensors would have read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.trial import CommandMode
from pytest_twin.trial.setpoint import Setpoint


@dataclass(frozen=True, slots=True)
class Unrecorded:
    """What no recording says of a model where a segment starts.

    Attributes:
        state: field of the simulator's data -> value: positions and velocities of the whole model,
            controls of drives that nobody commands, what actuators remember.
    """

    state: Mapping[str, FloatArray]

    @property
    def control(self) -> FloatArray:
        """(nu,) of drives that nobody commands, 0 for the others."""
        return self.state["ctrl"]


@dataclass(frozen=True, slots=True)
class Segment:
    """A stretch of a trial, simulated from its own initial state. Arrays in the model's frame.

    Attributes:
        trial: index of the trial.
        model: what to step, the trial's controller and payload applied.
        mode: ``position``, ``velocity`` or ``effort``: what is commanded; of joints with different
            modes, effort before velocity before position.
        start: s on the trial's clock, where the simulation begins.
        time: (n,) s on the trial's clock, stamps of the samples.
        position: (n, joints) rad or m, measured.
        velocity, effort: (n, joints) or None.
        command_time: (m,) s on the trial's clock.
        modes: (joints,) what each joint's command is; empty where it is ``mode`` for all.
        moving: whether a command moves in a straight line from stamp to stamp, or steps at each.
        command: (m, joints); NaN columns for joints that are not commanded: position servos then
            stay where ``unrecorded`` has them.
        initial_position, initial_velocity: (joints,).
        history: where the start lies amid a motion, (m,) s on the trial's clock and (m, joints)
            positions and velocities of the whole trial, smoothed.
        motor_shift: (joints,) rad or m by which motors behind gears that give start elsewhere than
            where they would carry their links at rest, or where their windows' lead brought them.
        cold_fraction: 1 in the coldest trial, 0 in the warmest; 1 where nobody says.
        has_friction_creep: whether dry friction gives way under load as MuJoCo's default constraint
            has it.
        unrecorded: the rest of the model, by default at its reference without commands.
    """

    trial: int
    model: mujoco.MjModel
    mode: CommandMode
    start: float
    time: FloatArray
    position: FloatArray
    velocity: FloatArray | None
    effort: FloatArray | None
    command_time: FloatArray
    command: FloatArray
    initial_position: FloatArray
    initial_velocity: FloatArray
    history: tuple[FloatArray, FloatArray, FloatArray] | None = None
    motor_shift: FloatArray | None = None
    cold_fraction: float = 1.0
    has_friction_creep: bool = False
    unrecorded: Unrecorded | None = None
    modes: tuple[CommandMode, ...] = ()
    moving: bool = False

    def mode_of(self, joint: int) -> CommandMode:
        """What the command of a joint is."""
        return self.modes[joint] if self.modes else self.mode

    @property
    def setpoint(self) -> Setpoint:
        """What was commanded at every moment, without a delay."""
        return Setpoint(self.command_time, self.command, self.moving)

    @property
    def starts_in_motion(self) -> bool:
        """Whether it starts amid a motion."""
        return self.history is not None

    def part(self, inside: NDArray[np.bool_], **changes: Any) -> Segment:
        """The samples ``inside``, and what ``changes`` beside them."""
        return replace(
            self,
            time=self.time[inside],
            position=self.position[inside],
            velocity=None if self.velocity is None else self.velocity[inside],
            effort=None if self.effort is None else self.effort[inside],
            **changes,
        )

    def before(self, time: FloatArray) -> FloatArray:
        """Positions and velocities at (n,) s on the trial's clock, (2, n, joints); only
        :attr:`starts_in_motion` a motion.
        """
        assert self.history is not None
        stamps, *known = self.history
        columns = [[np.interp(time, stamps, x) for x in of_joints.T] for of_joints in known]
        return np.moveaxis(np.array(columns), 1, 2)


@dataclass(frozen=True, slots=True)
class Predicted:
    """What a row's sensors would have read at its segment's stamps; NaN where it diverged.

    Attributes:
        position, velocity, effort: (n, joints), SI units.
    """

    position: FloatArray
    velocity: FloatArray
    effort: FloatArray
