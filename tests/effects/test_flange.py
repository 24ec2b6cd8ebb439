"""Payload on a flange whose own inertia does not tell the tool axis."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from pytest_twin.diagnosis.problem import joint_scales, replay_nominal
from pytest_twin.effects import catalogue
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment

JOINTS = ("lift", "bend", "turn")
KG, AWAY = 0.8, 0.2
# Its centre of mass lies behind the flange, towards the arm.
FLANGE = '<inertial pos="0 .005 -.011" mass=".17" diaginertia="6e-5 9e-5 1e-4"/>'
# Some suppliers place the centre of mass at the flange origin.
POINT = FLANGE.replace("0 .005 -.011", "0 0 0")
TOOL = '<inertial pos="0 .005 .15" mass=".17" diaginertia="6e-5 9e-5 1e-4"/>'
LOAD = f"""<body pos="0 0 {AWAY}">
<inertial pos="0 0 0" mass="{KG}" diaginertia="1e-9 1e-9 1e-9"/></body>"""


def arm(last: str, load: str = "", turned: str = "1 0 0 0") -> mujoco.MjModel:
    """Two joints that lift against gravity and a last joint that rotates the flange."""
    return mujoco.MjModel.from_xml_string(f"""\
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body><joint name="lift" axis="0 1 0" damping="2"/>
<geom type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass="3"/>
<body pos=".4 0 0"><joint name="bend" axis="0 1 0" damping="1"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="2"/>
<body pos=".3 0 0" quat="{turned}"><joint name="turn" damping=".5"/>
{last}{load}</body></body></body></worldbody>
<actuator><position joint="lift" kp="400" kv="10"/><position joint="bend" kp="200" kv="6"/>
<position joint="turn" kp="40" kv="1"/></actuator></mujoco>""")


TOWARDS_X = "0.70710678 0 0.70710678 0"


def simulator(model: mujoco.MjModel) -> BatchSimulator:
    time = np.arange(0.0, 1.0, 0.01)
    command = 0.2 * np.sin(np.outer(time, [5.0, 7.0, 9.0]))
    still = np.zeros((len(time), 3))
    segment = Segment(
        trial=0, model=model, mode="position", start=0.0, command_time=time, command=command,
        time=time, position=still, velocity=None, effort=None, initial_position=np.zeros(3),
        initial_velocity=np.zeros(3),
    )  # fmt: skip
    return BatchSimulator([segment], JOINTS, threads=1)


@pytest.mark.parametrize(
    "flange", [FLANGE, POINT], ids=["centre of mass behind flange", "centre of mass at flange"]
)
def test_payload_distance_is_measured_along_the_flange_axis_away_from_the_arm(flange: str) -> None:
    bare, loaded = (simulator(arm(flange, load, TOWARDS_X)) for load in ("", LOAD))
    payload = catalogue()["payload"]
    values = {p.name: np.zeros((1, 3)) for p in payload.parameters}
    values["mass"][:], values["distance"][:] = KG, AWAY
    (said,) = bare.simulate(np.array([0]), {"payload": values})
    (truth,) = replay_nominal(loaded)
    (without,) = replay_nominal(bare)
    assert np.abs(without.position - truth.position).max() > 1e-2
    assert said.position == pytest.approx(truth.position, abs=1e-8)


def test_payload_length_scale_is_the_arm_for_a_flange_and_the_link_for_a_tool() -> None:
    flange, tool = (simulator(arm(last, turned=TOWARDS_X)) for last in (FLANGE, TOOL))
    payload = catalogue()["payload"]
    for stepped, length, mass in ((flange, 0.15 * 0.7, 0.17), (tool, np.hypot(0.005, 0.15), 0.17)):
        scales = joint_scales(stepped, replay_nominal(stepped))
        for p, unit in zip(payload.parameters[:2], (mass, length), strict=True):
            assert scales.value(p, -1) == pytest.approx(unit)
    heavy = arm(FLANGE, turned=TOWARDS_X)
    heavy.body_mass[1] = 30.0
    scales = joint_scales(simulator(heavy), replay_nominal(simulator(heavy)))
    assert scales.value(payload.parameters[0], -1) == pytest.approx(0.02 * 32.17)
