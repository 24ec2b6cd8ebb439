"""The part of a model's initial state that is not recorded.

Joints that are coupled to a recorded one have the position that the coupling gives. Servos without
a command hold their joints. Actuators with a state (filters, integrators) have settled at the first
command. If a segment starts during a motion, their state comes from a simulation along the measured
motion.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.segment import UnrecordedState
from pytest_twin.realization.driven_base import DrivenBase
from pytest_twin.realization.first_state import (
    follow_joint_equalities,
    holding_controls,
    settle_under_load,
)
from pytest_twin.realization.inputs import command_input
from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings
from pytest_twin.trial import CommandMode
from pytest_twin.trial.setpoint import Setpoint

Motion = tuple[FloatArray, FloatArray, FloatArray]
"""(n,) times in s on the trial's clock, and (n, joints) positions and velocities."""
_KINEMATIC_FIELDS = ("qpos", "qvel")
_MEMORY_FIELDS = ("time", "act", "history")


class HiddenState:
    """Computes the unrecorded state of a model at times of one trial.

    Args:
        model: the model of the trial.
        joints: names of the recorded joints.
        modes: (joints,) kinds of their commands.
        setpoints: setpoints on the trial's clock, in the model's coordinates; NaN columns for
            joints without a command.
        base: floating base that moves along its recorded pose.

    Raises:
        SpecError: the model has no actuator for a command.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        joints: Sequence[str],
        modes: Sequence[CommandMode],
        setpoints: Setpoint,
        motion: Motion,
        base: DrivenBase | None = None,
    ) -> None:
        self._base = base
        self._model, self._data = model, mujoco.MjData(model)
        self._motion = motion
        command = setpoints.value
        self._ids = [model.joint(joint).id for joint in joints]
        commanded = [j for j in range(len(joints)) if np.isfinite(command[:, j]).all()]
        self._has_memory = bool(model.na or self._data.history.size)
        self._reset_to(motion[1][0], np.zeros(len(joints)), float(motion[0][0]))
        self._idle = holding_controls(model, self._data, [joints[j] for j in commanded])
        sent = np.tile(self._idle, (len(command), 1))
        for j in commanded if self._has_memory else ():
            target = command_input(model, joints[j], modes[j])
            if target is not None:
                sent[:, target.control] = target.scale * command[:, j]
        self._sent = Setpoint(setpoints.time, sent, setpoints.is_linear)

    def at(
        self, starts: Sequence[float], states: Sequence[tuple[FloatArray, FloatArray]]
    ) -> list[UnrecordedState]:
        """The unrecorded state at the start of each segment.

        Args:
            starts: start times in s on the trial's clock, ascending.
            states: (joints,) positions and velocities at each start.
        """
        memories = self._memories(starts) if self._has_memory else [{} for _ in starts]
        out = []
        for (position, velocity), memory, start in zip(states, memories, starts, strict=True):
            self._reset_to(position, velocity, start)
            placed = {name: getattr(self._data, name).copy() for name in _KINEMATIC_FIELDS}
            out.append(UnrecordedState({**placed, **memory, "ctrl": self._idle}))
        return out

    def _memories(self, starts: Sequence[float]) -> list[dict[str, FloatArray]]:
        """States of the actuators at each start."""
        model, data = self._model, self._data
        time, position, velocity = self._motion
        step = float(model.opt.timestep)
        steps = np.rint(np.asarray(starts) / step).astype(np.int64)
        stamps = np.asarray(step * np.arange(int(steps.max(initial=0))), dtype=np.float64)
        q, v = (
            np.stack([np.interp(stamps, time, x) for x in values.T], axis=1)
            for values in (position, velocity)
        )
        sent = self._sent.at(stamps)
        self._reset_to(position[0], velocity[0], float(time[0]))
        data.ctrl[:] = self._sent.value[0]
        settle_under_load(model, data)
        out, since = [], 0
        with suppress_mujoco_warnings():
            for until in steps.tolist():
                for k in range(since, until):
                    self._set_state(q[k], v[k], float(stamps[k]))
                    data.ctrl[:] = sent[k]
                    mujoco.mj_step(model, data)
                since = until
                out.append(self._memory())
        return out

    def _memory(self) -> dict[str, FloatArray]:
        kept = {name: np.atleast_1d(getattr(self._data, name)).copy() for name in _MEMORY_FIELDS}
        return {name: value for name, value in kept.items() if value.size}

    def _reset_to(self, position: FloatArray, velocity: FloatArray, time: float) -> None:
        mujoco.mj_resetData(self._model, self._data)
        self._set_state(position, velocity, time)

    def _set_state(self, position: FloatArray, velocity: FloatArray, time: float) -> None:
        model, data = self._model, self._data
        if self._base is not None:
            self._base.place(data, time)
        data.qpos[model.jnt_qposadr[self._ids]] = position
        data.qvel[model.jnt_dofadr[self._ids]] = velocity
        follow_joint_equalities(model, data, self._ids)


__all__ = ["HiddenState", "Motion"]
