"""Rows that step together: a diverging row does not affect the others."""

from __future__ import annotations

import mujoco
import numpy as np

from pytest_twin.realization.engine import Batch, new_batch
from pytest_twin.realization.lockstep import lockstep
from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings

PENDULUM = """\
<mujoco><option timestep="0.002"/><worldbody><body name="link">
<joint name="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/>
</body></worldbody><actuator><motor joint="hinge"/></actuator></mujoco>
"""
STEPS = 60


def step_pendulums(pushed: dict[int, float], rows: int = 3) -> tuple[np.ndarray, list[int], Batch]:
    """Final angles, steps begun and batch; ``pushed`` maps rows to the torque from step 10 on."""
    batch = new_batch(mujoco.MjModel.from_xml_string(PENDULUM), rows, 1)
    angle, control = batch.bind("qpos"), batch.bind("ctrl")
    begun: list[int] = []

    def before(k: int) -> None:
        begun.append(k)
        for row, effort in pushed.items():
            control[row] = effort if k >= 10 else 0.0

    with suppress_mujoco_warnings():
        lockstep(batch, STEPS, before)
    return angle.copy(), begun, batch


def test_a_diverged_row_stops_and_the_others_continue() -> None:
    free, begun, _ = step_pendulums({})
    beside, _, batch = step_pendulums({1: 1e30})
    assert begun == list(range(STEPS))
    lost = batch.warning[:, :, 1].any(axis=1)
    assert lost.tolist() == [False, True, False]
    np.testing.assert_array_equal(beside[[0, 2]], free[[0, 2]])
    # MuJoCo resets a diverged row at each step and counts a warning: few mean it was dropped.
    assert batch.warning[1, :, 1].max() < STEPS // 3


def test_stepping_ends_when_all_rows_have_diverged() -> None:
    _, begun, _ = step_pendulums(dict.fromkeys(range(3), 1e30))
    assert 10 < len(begun) < STEPS // 2
