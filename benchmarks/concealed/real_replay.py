"""Open-loop simulation of a model under a recording's commands with MuJoCo only.

It shares no code with pytest-twin's replay. It is used to fit the validated models, to measure the
visibility of a hidden effect, and to find equivalent effects. Each window starts from the measured
state, so predictions of half a second are compared, before small errors grow.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from injections import Recorded

Floats = np.ndarray[Any, np.dtype[np.float64]]
Law = Callable[[mujoco.MjModel, mujoco.MjData, Floats], None]
"""Function that sets ``qfrc_applied`` or a friction limit before a step, from the (joints,)
command."""

WINDOW = 0.5
"""Duration of a window, s."""
HALF_SPAN, SAMPLES = 0.05, 5
"""Time on each side of a start, s, over which its velocity is estimated from positions, and largest
number of samples. At 500 Hz the acceleration of a carriage changes within 50 ms."""


def velocity_at(time: Floats, position: Floats, at: float) -> Floats:
    """(joints,) velocity at ``at`` s, from a parabola through the positions."""
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
    """(states, joints) predicted positions, restarted every ``WINDOW`` s, with held commands.

    Args:
        model: model with joints and actuators in the recording's order, positions without offset.
        recorded: commands, and states from which windows start.
        push: (joints,) constant effort in addition to the MJCF.
        law: further law that the MJCF does not contain.
        delay: command delay of every drive, s.
        start: function from measured to true positions.
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
            # The motion is stepped to the last step before the stamp, and extrapolated by velocity.
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
