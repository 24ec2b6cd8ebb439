"""Segments of trials that are simulated, and their predicted sensor readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.realization.driven_base import DrivenBase
from pytest_twin.trial import CommandMode
from pytest_twin.trial.setpoint import Setpoint


@dataclass(frozen=True, slots=True)
class UnrecordedState:
    """Initial state of the parts of a model that are not recorded.

    Attributes:
        state: field of ``MjData`` -> value: positions and velocities of the whole model, controls
            of drives without commands, and states of actuators.
    """

    state: Mapping[str, FloatArray]

    @property
    def control(self) -> FloatArray:
        """(nu,) controls of drives without commands; 0 for the others."""
        return self.state["ctrl"]


@dataclass(frozen=True, slots=True)
class Segment:
    """A part of a trial that is simulated from its own initial state.

    Joint values have the sign and zero of the model, in rad, m and s. Times are on the trial's
    clock.

    Attributes:
        model: the model with the trial's controller and payload.
        mode: command mode: ``position``, ``velocity`` or ``effort``; if joints have different ones,
            the first present of effort, velocity, position.
        start: time at which the simulation starts, s.
        time: (n,) stamps of the samples, s.
        position: (n, joints) measured positions, rad or m.
        velocity, effort: (n, joints) measured values, or None.
        command_time: (m,) stamps of the commands, s.
        command: (m, joints) commands; NaN columns for joints without commands, whose position
            servos hold the position in ``unrecorded``.
        modes: (joints,) command mode of each joint; empty if all have ``mode``.
        is_interpolated: whether commands are interpolated linearly between stamps instead of held.
        added_force: (m,) times in s and (m, joints) forces in N*m or N that act on the joints in
            addition to the model's; they are interpolated linearly.
        initial_position, initial_velocity: (joints,) initial state.
        history: for a start in motion: (m,) times and (m, joints) smoothed positions and velocities
            of the whole trial; else None.
        motor_shift: (joints,) shift of the initial position of motors behind elastic transmissions,
            relative to the equilibrium or to the result of the warm-up, rad or m.
        cold_fraction: 1 in the coldest trial, 0 in the warmest; 1 if temperatures are unknown.
        has_friction_creep: whether dry friction creeps under load, as with MuJoCo's default
            constraint.
        unrecorded: initial state of the other parts of the model; by default its reference pose
            without commands.
        base: floating base that moves along its recorded pose, for which ``model`` is made.
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
    unrecorded: UnrecordedState | None = None
    modes: tuple[CommandMode, ...] = ()
    is_interpolated: bool = False
    added_force: tuple[FloatArray, FloatArray] | None = None
    base: DrivenBase | None = None

    def mode_of(self, joint: int) -> CommandMode:
        """Command mode of a joint."""
        return self.modes[joint] if self.modes else self.mode

    @property
    def setpoint(self) -> Setpoint:
        """The commands as a function of time, without a delay."""
        return Setpoint(self.command_time, self.command, self.is_interpolated)

    @property
    def starts_in_motion(self) -> bool:
        """Whether the segment starts during a motion instead of at rest."""
        return self.history is not None

    def part(self, inside: NDArray[np.bool_], **changes: Any) -> Segment:
        """The segment with the samples ``inside``, an (n,) mask, and other attributes changed."""
        return replace(
            self,
            time=self.time[inside],
            position=self.position[inside],
            velocity=None if self.velocity is None else self.velocity[inside],
            effort=None if self.effort is None else self.effort[inside],
            **changes,
        )

    def state_before(self, time: FloatArray) -> FloatArray:
        """(2, n, joints) smoothed positions and velocities at (n,) times, s.

        Only for a segment that :attr:`starts_in_motion`.
        """
        assert self.history is not None
        stamps, *known = self.history
        columns = [[np.interp(time, stamps, x) for x in of_joints.T] for of_joints in known]
        return np.moveaxis(np.array(columns), 1, 2)


@dataclass(frozen=True, slots=True)
class Predicted:
    """Predicted sensor readings at the stamps of a segment; NaN if the simulation diverged.

    Attributes:
        position, velocity, effort: (n, joints), SI units.
    """

    position: FloatArray
    velocity: FloatArray
    effort: FloatArray
