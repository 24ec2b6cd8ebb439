"""Elastic gears and backlash where rotor inertia exceeds the link inertia."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.link_inertia import link_inertia
from pytest_twin.effects.motor_side import Gear
from pytest_twin.effects.segment import Segment

JOINTS = ("base", "middle", "tip")
ARMATURE = (0.3, 0.02, 0.002)
ARM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body>
    <joint name="base" axis="0 1 0" damping="1" armature="{}"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".8"/>
    <body pos=".3 0 0">
      <joint name="middle" axis="0 1 0" damping=".2" armature="{}"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".8"/>
      <body pos=".3 0 0">
        <joint name="tip" axis="0 1 0" damping=".02" armature="{}"/>
        <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".3"/>
      </body>
    </body>
  </body></worldbody>
  <actuator><motor joint="base"/><motor joint="middle"/><motor joint="tip"/></actuator>
</mujoco>
""".format(*ARMATURE)
POSES = np.array([[0.0, 0.0, 0.0], [0.4, -1.3, 0.7]])


def inertia_from_acceleration(joint: int, pose: FloatArray) -> float:
    """Link inertia, kg m^2: torque over acceleration at a joint without its rotor inertia.

    The other joints are free.
    """
    model = mujoco.MjModel.from_xml_string(ARM)
    model.dof_armature[joint] = 0.0
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    data.qpos[:] = pose
    data.qfrc_applied[joint] = 1.0
    mujoco.mj_forward(model, data)
    return float(1.0 / data.qacc[joint])


def test_link_inertia_equals_torque_over_acceleration_without_the_rotor() -> None:
    data = mujoco.MjData(mujoco.MjModel.from_xml_string(ARM))
    columns = np.arange(3)
    met = np.array([[inertia_from_acceleration(j, pose) for j in range(3)] for pose in POSES])
    for pose, expected in zip(POSES, met, strict=True):
        assert link_inertia(data, pose[None], columns, columns) == pytest.approx(expected)
    assert link_inertia(data, POSES, columns, columns) == pytest.approx(met.min(axis=0))
    # The free outer joints make the arm light compared with the rotor.
    assert met[0, 0] < 0.5 * ARMATURE[0]


def base_position(effect: str, values: dict[str, float], refine: int) -> FloatArray:
    """(samples,) base position, rad, under a square wave of torque through the gear."""
    time = 0.01 * np.arange(80, dtype=np.float64)
    command = np.zeros((len(time), 3))
    command[:, 0] = 25.0 * np.sign(np.sin(2.0 * np.pi * 3.0 * time))
    segment = Segment(
        trial=0, model=mujoco.MjModel.from_xml_string(ARM), mode="effort", start=0.0, time=time,
        position=np.zeros((len(time), 3)), velocity=None, effort=None, command_time=time,
        command=command, initial_position=np.array([0.0, 1.2, 0.5]), initial_velocity=np.zeros(3),
    )  # fmt: skip
    simulator = BatchSimulator([segment], JOINTS, threads=1, refine=refine)
    there = {effect: {n: np.array([[v, 0.0, 0.0]]) for n, v in values.items()}}
    found: FloatArray = simulator.simulate(np.array([0]), there)[0].position[:, 0]
    return found


@pytest.mark.parametrize(
    ("effect", "values", "within"),
    [
        ("backlash", {"gap": 0.02, "tooth_compliance": 1e-4}, 0.01),
        ("joint_elasticity", {"compliance": 1.0 / 2000.0, "damping_time": 0.004}, 0.01),
        ("joint_elasticity", {"compliance": 1e-6, "damping_time": 0.002}, 0.01),
    ],
    ids=["backlash", "compliant gear", "stiff gear"],
)
def test_a_light_link_moves_as_with_16_times_finer_steps(
    effect: str, values: dict[str, float], within: float
) -> None:
    coarse, fine = base_position(effect, values, 1), base_position(effect, values, 16)
    assert np.isfinite(coarse).all()
    assert np.ptp(fine) > 0.1
    assert np.abs(coarse - fine).max() < within + 0.03 * np.ptp(fine)


def test_tooth_stiffness_is_reduced_only_for_light_links() -> None:
    def gear_with_teeth(link: float) -> Gear:
        gear = Gear.rigid(np.zeros((1, 1)))
        one = np.ones((1, 1))
        gear.add_compliance(one > 0.0, 1e-4 * one, None, 0.3 * one, link * one, 0.002)
        return gear

    light, heavy, free = gear_with_teeth(0.03), gear_with_teeth(0.31), gear_with_teeth(np.inf)
    assert heavy.stiffness == free.stiffness == pytest.approx(1e4)
    assert heavy.damping == free.damping
    assert light.stiffness < 0.5 * heavy.stiffness
    # Per step, teeth in series with the rotor remove half of the link's momentum.
    teeth, momentum = light.stiffness * 0.002 + light.damping, 0.3 / 0.002
    assert teeth * momentum / (teeth + momentum) == pytest.approx(0.5 * 0.03 / 0.002)
