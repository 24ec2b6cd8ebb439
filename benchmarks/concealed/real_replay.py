"""Open-loop motion of a model under a recording's commands, by MuJoCo alone.

Shares no code with pytest-twin's replay. Serves three ends: to fit the models that follow, to say
how far a concealed effect moves the readings, and to say which other name would move them alike.
Each window starts from the measured state, so that what is compared is what a model does within
half a second, not what a small error grows to.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from injections import Recorded

Floats = np.ndarray[Any, np.dtype[np.float64]]
Law = Callable[[mujoco.MjModel, mujoco.MjData, Floats], None]
"""Sets ``qfrc_applied`` or a limit of friction before a step; gets the command, (joints,)."""

WINDOW = 0.5
"""s between fresh starts."""
HALF_SPAN, SAMPLES = 0.05, 5
"""s on each side of a start over which its velocity is taken from positions, and samples at most:
a carriage sampled at 500 Hz changes its acceleration within 50 ms."""


def velocity_at(time: Floats, position: Floats, at: float) -> Floats:
    """(joints,) slope of a parabola through the positions about ``at`` s."""
    span = min(HALF_SPAN, SAMPLES * float(np.median(np.diff(time))))
    near = np.flatnonzero(np.abs(time - at) <= span)
    if len(near) < 4:
        middle = int(np.clip(np.searchsorted(time, at), 2, len(time) - 3))
        near = np.arange(middle - 2, middle + 3)
    t = time[near] - at
    powers = np.stack([np.ones_like(t), t, t**2], axis=1)
    slope: Floats = np.linalg.lstsq(powers, position[near], rcond=None)[0][1]
    return slope


def replay(
    model: mujoco.MjModel,
    recorded: Recorded,
    push: Floats,
    law: Law | None = None,
    delay: float = 0.0,
    start: Callable[[Floats], Floats] = lambda position: position,
) -> Floats:
    """(states, joints) predicted positions, started anew every ``WINDOW`` s; commands are held.

    Args:
        model: joints and actuators in the recording's order, positions without offset.
        recorded: commands, and the states that windows start from.
        push: (joints,) constant effort beside the MJCF.
        law: what else the MJCF does not hold.
        delay: s by which every drive acts late.
        start: true positions of measured ones.
    """
    state, command = recorded.state, recorded.command
    assert state.position is not None
    origin = int(state.stamp[0])
    time = (state.stamp - origin) * 1e-9
    sent = (command.stamp - origin) * 1e-9 + delay
    asked = next(v for v in (command.position, command.effort, command.velocity) if v is not None)
    measured = start(state.position)
    step, data = model.opt.timestep, mujoco.MjData(model)
    out = np.empty_like(state.position)
    begin = 0
    while begin < len(time):
        end = int(np.searchsorted(time, time[begin] + WINDOW - 1e-9))
        mujoco.mj_resetData(model, data)
        data.qpos[:] = measured[begin]
        data.qvel[:] = velocity_at(time, measured, time[begin])
        data.qfrc_applied[:] = push
        now = time[begin]
        for k in range(begin, end):
            # Whole steps to the last one before the stamp, and on by velocity to the stamp itself.
            while now + step <= time[k] + 1e-9:
                latest = max(int(np.searchsorted(sent, now + 1e-9, side="right")) - 1, 0)
                data.ctrl[:] = asked[latest]
                following = sent[latest + 1] if latest + 1 < len(sent) else np.inf
                steps = 1
                if law is None:
                    until = min(time[k], following)
                    steps = max(int((until - now) / step + 1e-6), 1)
                else:
                    law(model, data, asked[latest])
                mujoco.mj_step(model, data, steps)
                now += steps * step
            out[k] = data.qpos + data.qvel * (time[k] - now)
        begin = end
    return out
