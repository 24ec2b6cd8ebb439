"""Disabling unused MuJoCo features leaves the motion bitwise identical."""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np
import pytest

from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.engine_options import disable_unused_features
from pytest_twin.effects.segment import Segment
from pytest_twin.realization.engine import Batch

ARM = """\
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>{floor}
<body pos="0 0 .3"><joint name="a" axis="0 1 0" damping=".2" frictionloss=".3" range="-60 60"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1" {of}/>
<body pos=".3 0 0"><joint name="b" axis="0 1 0" damping=".1" frictionloss=".1"/>
<geom name="tip" type="capsule" fromto="0 0 0 .25 0 0" size=".02" mass=".5" {of}/></body></body>
{other}</worldbody><actuator><position joint="a" kp="20" kv="1"/><motor joint="b"/></actuator>
{more}</mujoco>
"""
BOX = '<body name="box" pos=".3 0 .1"><freejoint/><geom size=".04" mass=".2"/></body>'
APART = 'contype="0" conaffinity="0"'
FLOOR = '<geom name="floor" type="plane" size="1 1 .1"/>'
FLOOR_APART = f'<geom name="floor" type="plane" size="1 1 .1" {APART}/>'
PAIR = '<contact><pair geom1="floor" geom2="tip"/></contact>'


def arm(floor: str = "", of: str = "", other: str = "", more: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM.format(floor=floor, of=of, other=other, more=more))


def simulated_states(model: mujoco.MjModel) -> np.ndarray:
    """(steps, states) one second of motion that reaches the joint limit and any obstacle."""
    data = mujoco.MjData(model)
    states = []
    for k in range(500):
        data.ctrl[:] = 2.0 * np.sin(0.02 * k), 1.5 * np.cos(0.03 * k)
        mujoco.mj_step(model, data)
        states.append(np.concatenate([data.qpos, data.qvel, data.qfrc_constraint]))
    return np.array(states)


@pytest.mark.parametrize(
    ("fields", "islands", "contacts"),
    [
        ({"of": APART}, False, False),
        ({"of": APART, "floor": FLOOR}, False, True),
        ({"floor": FLOOR}, False, True),
        ({"floor": FLOOR, "other": BOX}, True, True),
        ({"of": APART, "floor": FLOOR_APART}, False, False),
    ],
    ids=[
        "no floor",
        "floor collides with arm",
        "floor and arm collide",
        "free object",
        "no collisions",
    ],
)
def test_disabling_unused_features_leaves_the_motion_bitwise_identical(
    fields: dict[str, str], islands: bool, contacts: bool
) -> None:
    model = arm(**fields)
    spared = copy.copy(model)
    disable_unused_features(spared)
    off = mujoco.mjtDisableBit
    assert bool(spared.opt.disableflags & int(off.mjDSBL_ISLAND)) is not islands
    assert bool(spared.opt.disableflags & int(off.mjDSBL_CONTACT)) is not contacts
    np.testing.assert_array_equal(simulated_states(model), simulated_states(spared))


def test_explicit_contact_pairs_still_collide() -> None:
    model = arm(floor=FLOOR_APART, of=APART)
    met = arm(floor=FLOOR_APART, of=APART, more=PAIR)
    spared = copy.copy(met)
    disable_unused_features(spared)
    np.testing.assert_array_equal(simulated_states(met), simulated_states(spared))
    assert (simulated_states(met) != simulated_states(model)).any(), (
        "the pair does not collide in this motion"
    )


def test_the_batch_simulator_does_not_replace_the_mujoco_clock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    replaced = []
    rollout = Batch.rollout

    def watched(*args: Any, **kwargs: Any) -> Any:
        replaced.append(mujoco.get_mjcb_time() is not None)
        return rollout(*args, **kwargs)

    monkeypatch.setattr(Batch, "rollout", watched)
    time, still = 0.01 * np.arange(3), np.zeros((3, 1))
    segment = Segment(
        0, arm(), "position", 0.0, time, still, None, None, time[:1], still[:1], still[0], still[0]
    )
    BatchSimulator([segment], ("a",), threads=1).simulate(np.array([0]), {})
    assert replaced == [False]
