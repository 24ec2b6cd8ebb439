"""What no recording says of a model where a segment starts.

Joints that follow a recorded one stand where that takes them, and servos that nobody commands hold
theirs. Actuators that remember (filters, integrators) have settled on the first command; amid a
motion they have lived through what came before: the model is stepped along what was measured.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.segment import Unrecorded
from pytest_twin.realization.first_state import (
    follow_joint_equalities,
    holding_controls,
    settle_under_load,
)
from pytest_twin.realization.inputs import command_input
from pytest_twin.realization.quiet import quiet
from pytest_twin.trial import CommandMode
from pytest_twin.trial.setpoint import Setpoint

Motion = tuple[FloatArray, FloatArray, FloatArray]
"""(n,) s on the trial's clock, and (n, joints) positions and velocities."""
_PLACED = ("qpos", "qvel")
_REMEMBERED = ("time", "act", "history")


class HiddenState:
    """The rest of a model, in one trial.

    Args:
        model: what the trial is stepped on.
        joints: that were recorded.
        modes: (joints,) what their commands are.
        asked: what was commanded, on the trial's clock and in the model's terms; NaN columns for
            joints that are not commanded.
        motion: as measured.

    Raises:
        SpecError: a command that the model has no actuator for.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        joints: Sequence[str],
        modes: Sequence[CommandMode],
        asked: Setpoint,
        motion: Motion,
    ) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._motion = motion
        command = asked.value
        self._ids = [model.joint(joint).id for joint in joints]
        commanded = [j for j in range(len(joints)) if np.isfinite(command[:, j]).all()]
        self._remembers = bool(model.na or self._data.history.size)
        self._place(motion[1][0], np.zeros(len(joints)))
        self._idle = holding_controls(model, self._data, [joints[j] for j in commanded])
        sent = np.tile(self._idle, (len(command), 1))
        for j in commanded if self._remembers else ():
            target = command_input(model, joints[j], modes[j])
            if target is not None:
                sent[:, target.control] = target.scale * command[:, j]
        self._sent = Setpoint(asked.time, sent, asked.linear)

    def at(
        self, starts: Sequence[float], states: Sequence[tuple[FloatArray, FloatArray]]
    ) -> list[Unrecorded]:
        """Where segments start.

        Args:
            starts: s on the trial's clock, ascending.
            states: (joints,) positions and velocities of each.
        """
        memories = self._memories(starts) if self._remembers else [{} for _ in starts]
        out = []
        for (position, velocity), memory in zip(states, memories, strict=True):
            self._place(position, velocity)
            placed = {name: getattr(self._data, name).copy() for name in _PLACED}
            out.append(Unrecorded({**placed, **memory, "ctrl": self._idle}))
        return out

    def _memories(self, starts: Sequence[float]) -> list[dict[str, FloatArray]]:
        """What actuators remember at each start."""
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
        self._place(position[0], velocity[0])
        data.ctrl[:] = self._sent.value[0]
        settle_under_load(model, data)
        out, since = [], 0
        with quiet():
            for until in steps.tolist():
                for k in range(since, until):
                    self._put(q[k], v[k])
                    data.ctrl[:] = sent[k]
                    mujoco.mj_step(model, data)
                since = until
                out.append(self._memory())
        return out

    def _memory(self) -> dict[str, FloatArray]:
        kept = {name: np.atleast_1d(getattr(self._data, name)).copy() for name in _REMEMBERED}
        return {name: value for name, value in kept.items() if value.size}

    def _place(self, position: FloatArray, velocity: FloatArray) -> None:
        mujoco.mj_resetData(self._model, self._data)
        self._put(position, velocity)

    def _put(self, position: FloatArray, velocity: FloatArray) -> None:
        model, data = self._model, self._data
        data.qpos[model.jnt_qposadr[self._ids]] = position
        data.qvel[model.jnt_dofadr[self._ids]] = velocity
        follow_joint_equalities(model, data, self._ids)


__all__ = ["HiddenState", "Motion"]
