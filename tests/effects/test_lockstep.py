"""Rows that step together: one that diverges costs the others nothing."""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco.batch import Batch

from pytest_twin.realization.lockstep import lockstep
from pytest_twin.realization.quiet import quiet

PENDULUM = """\
<mujoco><option timestep="0.002"/><worldbody><body name="link">
<joint name="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/>
</body></worldbody><actuator><motor joint="hinge"/></actuator></mujoco>
"""
STEPS = 60


def stepped(pushed: dict[int, float], rows: int = 3) -> tuple[np.ndarray, list[int], Batch]:
    """Final angles, the steps that were begun, and the batch; ``pushed`` rows from step 10 on."""
    batch = Batch(mujoco.MjModel.from_xml_string(PENDULUM), rows, nthread=1)
    angle, control = batch.bind("qpos"), batch.bind("ctrl")
    begun: list[int] = []

    def before(k: int) -> None:
        begun.append(k)
        for row, effort in pushed.items():
            control[row] = effort if k >= 10 else 0.0

    with quiet():
        lockstep(batch, STEPS, before)
    return angle.copy(), begun, batch


def test_a_row_that_diverges_stops_and_the_others_go_on() -> None:
    free, begun, _ = stepped({})
    beside, _, batch = stepped({1: 1e30})
    assert begun == list(range(STEPS))
    lost = batch.warning[:, :, 1].any(axis=1)
    assert lost.tolist() == [False, True, False]
    np.testing.assert_array_equal(beside[[0, 2]], free[[0, 2]])
    # The engine starts a diverged row anew at each step, and counts: this one was left alone soon.
    assert batch.warning[1, :, 1].max() < STEPS // 3


def test_nothing_is_stepped_where_all_diverged() -> None:
    _, begun, _ = stepped(dict.fromkeys(range(3), 1e30))
    assert 10 < len(begun) < STEPS // 2
