"""Every installed effect leaves predictions unchanged at its neutral values."""

from __future__ import annotations

import itertools
from importlib.metadata import entry_points

import mujoco
import numpy as np
import pytest

from pytest_twin.effects import Effect, catalogue
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Predicted, Segment

JOINTS = ("swing", "slide", "wrist")
STEP, SAMPLES = 0.002, 150
NAMES = sorted(point.name for point in entry_points(group="pytest_twin.effects"))


def model() -> mujoco.MjModel:
    """Two hinges and a slide with dry friction above a floor; position and velocity servos."""
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody>
        <geom name="floor" type="plane" size="2 2 0.1" pos="0 0 -0.36"/>
        <body><inertial pos="0 0 -0.1" mass="0.5" diaginertia="2e-3 2e-3 1e-3"/>
        <joint name="swing" axis="0 1 0" damping="0.05" armature="0.003" frictionloss="0.05"/>
        <body pos="0 0 -0.1"><inertial pos="0 0 -0.1" mass="0.3" diaginertia="1e-3 1e-3 1e-3"/>
        <joint name="slide" type="slide" axis="0 0 1" damping="2" frictionloss="0.2"/>
        <body pos="0 0 -0.1"><inertial pos="0.02 0 -0.06" mass="0.2" diaginertia="5e-4 5e-4 5e-4"/>
        <geom type="sphere" size="0.03" pos="0 0 -0.12" mass="0"/>
        <joint name="wrist" axis="0 1 0" damping="0.02" armature="0.001"/></body></body></body>
        </worldbody><actuator><position joint="swing" kp="8" kv="0.3" forcerange="-3 3"/>
        <position joint="slide" kp="200" kv="5"/><velocity joint="wrist" kv="0.4"/></actuator>
        </mujoco>"""
    )


def segment(cold_fraction: float) -> Segment:
    time = STEP * np.arange(SAMPLES, dtype=np.float64)
    command = np.stack(
        [0.4 * np.sin(9.0 * time), -0.03 + 0.02 * np.cos(14.0 * time), np.sin(20.0 * time)], axis=1
    )
    return Segment(
        trial=0, model=model(), mode="velocity", modes=("position", "position", "velocity"),
        start=0.0, time=time, position=np.zeros((SAMPLES, 3)), velocity=None, effort=None,
        command_time=time[::10], command=command[::10], cold_fraction=cold_fraction,
        initial_position=np.zeros(3), initial_velocity=np.zeros(3),
    )  # fmt: skip


SIMULATOR = BatchSimulator([segment(1.0), segment(0.0)], JOINTS, threads=1)


def predictions(effect: Effect | None, shape: float = 0.0, trial: int = 0) -> list[Predicted]:
    """Three predictions: without the effect, with its starting values, with its neutral values.

    The last two are rows of one batch.

    Args:
        effect: None for the first prediction alone.
        trial: 0 for the coldest, 1 for the warmest.
        shape: 0 to 1, picks each parameter's first to last starting value.
    """
    plain = SIMULATOR.trajectories_with_readings(np.array([trial]), {})[2]
    if effect is None:
        return plain
    rows: dict[str, np.ndarray] = {}
    for p in effect.parameters:
        start = p.starts[round(shape * (len(p.starts) - 1))]
        neutral = start if p.neutral is None else p.neutral
        rows[p.name] = np.array([[start] * 3, [neutral] * 3])
    return plain + SIMULATOR.trajectories_with_readings(np.full(2, trial), {effect.id: rows})[2]


def largest_relative_difference(a: Predicted, b: Predicted) -> float:
    """Largest relative difference of position, velocity and effort."""
    pairs = ((getattr(a, n), getattr(b, n)) for n in ("position", "velocity", "effort"))
    return max(float(np.abs(x - y).max() / max(1.0, np.abs(x).max())) for x, y in pairs)


@pytest.mark.parametrize("shape", [0.0, 1.0], ids=["first starting value", "last starting value"])
@pytest.mark.parametrize("name", NAMES)
def test_neutral_values_change_nothing(name: str, shape: float) -> None:
    plain, _, neutral = predictions(catalogue()[name], shape)
    assert np.isfinite(plain.position).all()
    # The tolerance of the solver for dry friction and contact is 1e-8.
    assert largest_relative_difference(plain, neutral) <= 1e-9


@pytest.mark.parametrize("name", NAMES)
def test_starting_values_change_something(name: str) -> None:
    """Otherwise the test above would pass for an effect that never acts on this robot."""
    ways = itertools.product((0.0, 1.0), (0, 1))
    changes = (
        largest_relative_difference(*predictions(catalogue()[name], *way)[:2]) for way in ways
    )
    assert any(not change <= 1e-7 for change in changes)


def test_the_motion_includes_contact_sticking_and_saturation() -> None:
    """Otherwise effects that act only in these regimes would not be tested."""
    (plain,) = predictions(None)
    assert plain.effort[:, 0].max() > 2.0
    assert np.ptp(plain.position, axis=0).min() > 0.01
