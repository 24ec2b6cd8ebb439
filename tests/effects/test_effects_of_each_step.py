"""What an effect changes between steps acts at every step, and at its own joint only."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np
import pytest

from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Predicted, Segment

JOINTS = ("left", "right")
_BODY = (
    '<body pos="{1} 0 0"><inertial pos="0 0 -.1" mass=".5" diaginertia=".005 .005 .005"/>'
    '<joint name="{0}" axis="0 1 0" damping=".05" armature=".01"/></body>'
)
_SERVO = '<position joint="{0}" kp="30" kv=".5" forcerange="-4 4"/>'
MODEL = (
    '<mujoco><option timestep="0.002" integrator="implicitfast"/>'
    f"<worldbody>{''.join(_BODY.format(j, i) for i, j in enumerate(JOINTS))}</worldbody>"
    f"<actuator>{''.join(map(_SERVO.format, JOINTS))}</actuator></mujoco>"
)


def simulated(effects: Mapping[str, Mapping[str, tuple[float, float]]]) -> Predicted:
    """Motion of two pendulums after a step of both commands; values of the left and right joint."""
    time = 0.002 * np.arange(400)
    command = np.full((len(time), 2), 1.0)
    segment = Segment(
        trial=0, model=mujoco.MjModel.from_xml_string(MODEL), mode="position", start=0.0,
        time=time, position=np.zeros((len(time), 2)), velocity=None, effort=None,
        command_time=time, command=command, initial_position=np.zeros(2),
        initial_velocity=np.zeros(2),
    )  # fmt: skip
    values = {e: {n: np.array([v]) for n, v in p.items()} for e, p in effects.items()}
    return BatchSimulator([segment], JOINTS, threads=1).simulate(np.array([0]), values)[0]


def test_a_limit_that_falls_with_speed_is_applied_at_every_step() -> None:
    """At its no-load speed the drive has no effort, so the joint cannot become faster."""
    no_load = 2.0
    limit = {"inverse_no_load_speed": (1.0 / no_load, 0.0), "stall": (4.0, 4.0)}
    found = simulated({"torque_speed_limit": limit})
    fastest = np.abs(found.velocity).max(axis=0)
    assert fastest[0] < 1.02 * no_load
    assert fastest[1] > 3.0 * no_load, "without the limit the same command is far faster"


@pytest.mark.parametrize(
    "effects",
    [
        {"cogging": {"sine": (0.0, 0.3), "cosine": (0.0, 0.1), "harmonic": (7.0, 7.0)}},
        {"quadratic_drag": {"coefficient": (0.0, 0.05)}},
        {"actuator_lag": {"time_constant": (0.0, 0.01), "of_setpoint": (0.0, 0.0)}},
    ],
    ids=["force", "drag", "drive"],
)
def test_a_rigid_joint_moves_the_same_beside_an_elastic_one(
    effects: Mapping[str, Mapping[str, tuple[float, float]]],
) -> None:
    elastic = {"compliance": (0.05, 0.0), "damping_time": (0.01, 0.01)}
    alone, beside = simulated(effects), simulated({**effects, "joint_elasticity": elastic})
    assert beside.position[:, 1] == pytest.approx(alone.position[:, 1], abs=1e-3)
    # Both the elasticity and the other effect change the motion of their joints.
    bare = simulated({})
    assert np.abs(beside.position[:, 0] - bare.position[:, 0]).max() > 0.02
    assert np.abs(alone.position[:, 1] - bare.position[:, 1]).max() > 0.02
