"""Open-loop replay of one trial with an added joint force that is computed at each step."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.open_loop import Replayed, Row, RowSimulation
from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings

Force = Callable[[float, FloatArray, FloatArray], FloatArray]
"""(time in s, positions, velocities) -> force on each joint, N*m or N.

Joints are in the order of the trial, in the signs and zeros of the model.
"""
_SPEED = 1e6
"""rad/s or m/s beyond which a simulation has diverged; MuJoCo's own bound is 1e10."""


def replay_forced(
    row: Row, force: Force, *, kick: tuple[float, FloatArray] | None = None
) -> Replayed:
    """Replay a trial, as :func:`pytest_twin.open_loop.replay_rows` does, with an added force.

    The steps are those of ``mj_step``; the force is called before each.

    Args:
        row: one trial and its model.
        force: joint force that is added.
        kick: an impact: time (s), and change of the joints' velocities (j,), rad/s or m/s.
    """
    data = mujoco.MjData(row.model)
    run = RowSimulation(row, data)
    model, count = run.model, run.steps
    for name, value in run.initial.items():
        getattr(data, name)[...] = value
    width = model.nu + (model.nv if run.applies_effort else 0)
    controls = np.empty((count, width))
    run.controls(0, count, controls)
    qpos, qvel = np.empty((count, model.nq)), np.empty((count, model.nv))
    effort = np.empty((count, model.nv))
    kicked_at = -1 if kick is None else round(kick[0] / run.timestep)
    added = np.zeros(model.nv)
    with suppress_mujoco_warnings():
        for step in range(count):
            if kick is not None and step == kicked_at:
                data.qvel[run.dof_index] += kick[1]
            time = step * run.timestep
            added[run.dof_index] = force(time, data.qpos[run.qpos_index], data.qvel[run.dof_index])
            data.ctrl[:] = controls[step, : model.nu]
            data.qfrc_applied[:] = added
            if run.applies_effort:
                data.qfrc_applied[:] += controls[step, model.nu :]
            mujoco.mj_step(model, data)
            qpos[step], qvel[step], effort[step] = data.qpos, data.qvel, data.qfrc_actuator
            if run.applies_effort:
                effort[step] += controls[step, model.nu :]
            if not np.abs(data.qvel).max(initial=0.0) < _SPEED:
                run.fail("the velocity diverged", step, None)
                break
    if run.error is None:
        run.store(qpos, qvel, effort)
    return run.result()
