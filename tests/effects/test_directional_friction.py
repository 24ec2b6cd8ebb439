"""Friction that depends on the direction of motion or of power flow, against closed forms."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment

STEP, INERTIA, DAMPING = 0.001, 0.01, 0.05
MASS, ARM = 0.4, 0.25
WEIGHT = MASS * 9.81 * ARM


def model(mass: float) -> mujoco.MjModel:
    """A horizontal link of the given mass (kg), driven by a joint torque."""
    inertial = f'<inertial pos="{ARM} 0 0" mass="{mass}" diaginertia="1e-9 1e-9 1e-9"/>'
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody><body>{inertial}'
        f'<joint name="j" axis="0 -1 0" armature="{INERTIA}" damping="{DAMPING}"/></body>'
        '</worldbody><actuator><motor joint="j"/></actuator></mujoco>'
    )


def velocities(effort: FloatArray, effects: dict[str, dict[str, float]], mass: float) -> FloatArray:
    """(steps,) joint velocity, rad/s, under the given torques (N*m)."""
    time: FloatArray = STEP * np.arange(len(effort), dtype=np.float64)
    segment = Segment(
        trial=0, model=model(mass), mode="effort", start=0.0, time=time,
        position=np.zeros((len(time), 1)), velocity=None, effort=None,
        command_time=time, command=effort[:, None],
        initial_position=np.zeros(1), initial_velocity=np.zeros(1),
    )  # fmt: skip
    simulator = BatchSimulator([segment], ("j",), threads=1)
    rows = {e: {n: np.full((1, 1), x) for n, x in v.items()} for e, v in effects.items()}
    return simulator.simulate(np.array([0]), rows)[0].velocity[:, 0]


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_constant_effort_gives_the_speed_of_that_directions_viscous_friction(way: float) -> None:
    law = {"directional_viscous_friction": {"coefficient": 0.1, "difference": 0.06}}
    velocity = velocities(np.full(1500, 0.3 * way), law, 1e-6)
    assert velocity[-1] == pytest.approx(way * 0.3 / (DAMPING + 0.1 + way * 0.06), rel=1e-3)
    rise = velocity[150] / velocity[-1]
    rate = (DAMPING + 0.1 + way * 0.06) / INERTIA
    assert rise == pytest.approx(1.0 - np.exp(-rate * 0.15), abs=0.01)


def breaks_away(effort: float, forward: float, backward: float) -> bool:
    """Whether a loaded arm at rest exceeds 0.02 rad/s under a constant effort."""
    law = {"gear_efficiency": {"forward_loss": forward, "backward_loss": backward}}
    return bool(np.abs(velocities(np.full(100, effort), law, MASS)).max() > 0.02)


@pytest.mark.parametrize(("forward", "backward"), [(0.2, 0.6), (0.4, 0.1)])
def test_a_loaded_arm_breaks_away_where_effort_after_gear_losses_exceeds_the_load(
    forward: float, backward: float
) -> None:
    up, down = WEIGHT / (1.0 - forward), WEIGHT / (1.0 + backward)
    assert breaks_away(1.05 * up, forward, backward)
    assert not breaks_away(0.95 * up, forward, backward)
    assert not breaks_away(1.05 * down, forward, backward)
    assert breaks_away(0.93 * down, forward, backward)


def test_a_self_locking_gear_holds_the_load_at_small_effort() -> None:
    assert not breaks_away(0.3 * WEIGHT, 0.4, 3.0)
    assert breaks_away(0.3 * WEIGHT, 0.4, 1.0)


def test_equal_gear_losses_equal_load_dependent_friction_of_the_drive() -> None:
    effort = 1.4 * WEIGHT * np.sign(np.sin(2 * np.pi * 2.5 * STEP * np.arange(800)))
    even = {"gear_efficiency": {"forward_loss": 0.2, "backward_loss": 0.2}}
    plain = {"load_dependent_friction": {"coefficient": 0.2, "of_drive": 1.0}}
    assert np.array_equal(velocities(effort, even, MASS), velocities(effort, plain, MASS))
    law = catalogue()["gear_efficiency"]
    simple = law.special_cases({"forward_loss": 0.1, "backward_loss": 0.3})
    assert simple["load_dependent_friction"]["coefficient"] == pytest.approx(0.2)
