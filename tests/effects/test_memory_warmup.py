"""A window that starts during a motion restores the internal state of its effects."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment

STEP, START = 0.001, 0.6
MODEL = (
    f'<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody><body>'
    '<inertial pos="0 0 -0.2" mass="0.5" diaginertia="0.002 0.002 0.002"/>'
    '<joint name="j" axis="0 -1 0" armature="0.01" damping="0.05"/></body></worldbody>'
    '<actuator><motor joint="j"/></actuator></mujoco>'
)
LAWS = {
    "actuator lag": ("actuator_lag", {"time_constant": 0.03, "of_setpoint": 0.0}),
    "elastic transmission": ("joint_elasticity", {"compliance": 1 / 40.0, "damping_time": 0.01}),
    "presliding": ("presliding_hysteresis", {"coulomb": 0.3, "presliding_distance": 0.05}),
    # The joint moves at about 0.1 rad/s: the deflection began before the warm-up.
    "presliding longer than the warm-up": (
        "presliding_hysteresis",
        {"coulomb": 2.0, "presliding_distance": 0.4},
    ),
}


def values(law: str) -> dict[str, dict[str, FloatArray]]:
    effect, parameters = LAWS[law]
    return {effect: {n: np.full((1, 1), v) for n, v in parameters.items()}}


def whole_trial() -> Segment:
    """One second of motion under an effort that never settles."""
    time: FloatArray = STEP * np.arange(1000, dtype=np.float64)
    command = 1.2 * np.sin(2.0 * np.pi * 1.3 * time) + 0.5 * np.sign(np.sin(2.0 * np.pi * 4 * time))
    return Segment(
        trial=0, model=mujoco.MjModel.from_xml_string(MODEL), mode="effort", start=0.0, time=time,
        position=np.zeros((1000, 1)), velocity=None, effort=None,
        command_time=time, command=command[:, None],
        initial_position=np.zeros(1), initial_velocity=np.zeros(1),
    )  # fmt: skip


@pytest.mark.parametrize("law", LAWS)
def test_a_window_with_history_continues_the_motion(law: str) -> None:
    trial = whole_trial()
    simulator = BatchSimulator([trial], ("j",), threads=1)
    motion = simulator.simulate(np.array([0]), values(law))[0]
    at = round(START / STEP)
    window = replace(
        trial, start=START, time=trial.time[at : at + 200], position=motion.position[at : at + 200],
        initial_position=motion.position[at], initial_velocity=motion.velocity[at],
        history=(trial.time, motion.position, motion.velocity),
    )  # fmt: skip

    def error(segment: Segment) -> float:
        found = BatchSimulator([segment], ("j",), threads=1).simulate(np.array([0]), values(law))
        return float(np.abs(found[0].position - segment.position).max())

    moved = float(np.ptp(window.position))
    assert error(window) < 0.01 * moved
    assert error(replace(window, history=None)) > 5.0 * error(window)


SERVO = MODEL.replace(
    '<motor joint="j"/>', '<position joint="j" kp="30" kv="1" forcerange="-20 20"/>'
)
FOLLOWERS = {
    # A step of 1 rad at 1/3 rad/s: the setpoint stays seconds behind the command.
    "velocity-limited profile": ("rate_limit", {
        "inverse_rate": 3.0, "inverse_effort_rate": 0.0, "of_effort": 0.0}),
    "smoothed setpoint": ("actuator_lag", {"time_constant": 0.5, "of_setpoint": 1.0}),
    "watchdog": ("watchdog_timeout", {"inverse_timeout": 2.0, "back_emf": 0.0}),
}  # fmt: skip


@pytest.mark.parametrize("law", FOLLOWERS)
def test_effects_on_commands_know_all_commands_before_the_window(law: str) -> None:
    effect, parameters = FOLLOWERS[law]
    told = {effect: {n: np.full((1, 1), v) for n, v in parameters.items()}}
    time: FloatArray = STEP * np.arange(3000, dtype=np.float64)
    trial = Segment(
        trial=0, model=mujoco.MjModel.from_xml_string(SERVO), mode="position", start=0.0,
        time=time, position=np.zeros((3000, 1)), velocity=None, effort=None,
        command_time=np.array([0.0, 0.1, 1.4037]), command=np.array([[0.0], [1.0], [-0.5]]),
        initial_position=np.zeros(1), initial_velocity=np.zeros(1),
    )  # fmt: skip
    motion = BatchSimulator([trial], ("j",), threads=1).simulate(np.array([0]), told)[0]
    windows = [
        replace(
            trial, start=STEP * at, time=time[at : at + 300], position=motion.position[at:][:300],
            initial_position=motion.position[at], initial_velocity=motion.velocity[at],
            history=(time, motion.position, motion.velocity),
        )
        for at in (50, 900, 1500, 2600)
    ]  # fmt: skip
    cut = BatchSimulator(windows, ("j",), threads=1)
    # Rows out of order; the first has another parameter value.
    rows = np.array([3, 0, 1, 2, 3])
    each = {effect: {n: np.repeat(v, 5, axis=0) for n, v in told[effect].items()}}
    first = next(iter(parameters))
    each[effect][first][0] = 0.0
    found = cut.simulate(rows, each)
    for r, p in zip(rows[1:], found[1:], strict=True):
        assert p.position == pytest.approx(windows[r].position, abs=2e-3 * np.ptp(motion.position))
    assert np.abs(found[0].position - windows[3].position).max() > 0.1
