"""Mean command of a drive over a simulation step in which its command changes."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.commands_over_steps import CommandsOverSteps
from pytest_twin.effects.segment import Segment

STEP = 0.01


def segment(drive: str, sent: list[float], stamps: list[float]) -> Segment:
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP}" gravity="0 0 0"/><worldbody><body>'
        '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint name="j" axis="0 0 1"/>'
        f'</body></worldbody><actuator><motor name="j" joint="j" {drive}/></actuator></mujoco>'
    )
    time = STEP * np.arange(5)
    return Segment(
        0, model, "effort", 0.0, time, np.zeros((5, 1)), None, None,
        np.array(stamps), np.array(sent)[:, None], np.zeros(1), np.zeros(1),
    )  # fmt: skip


def mean_commands(held: CommandsOverSteps) -> FloatArray:
    """Mean commands of the first four steps."""
    none = np.zeros((1, 1))
    return held.means(np.array([0]), none, 4, none.astype(np.int64), STEP)[0, :, 0]


def test_commands_are_limited_before_they_are_averaged_over_a_step() -> None:
    """The command changes from 3 to -3 after three quarters of the second step; the limit is 1."""
    given = segment("", [3.0, -3.0], [0.0, 1.75 * STEP])
    one = np.ones((1, 1))
    free = CommandsOverSteps([given], STEP, 0.0 * one, -np.inf * one, np.inf * one)
    np.testing.assert_allclose(mean_commands(free), [3.0, 1.5, -3.0, -3.0])
    limited = CommandsOverSteps([given], STEP, 0.0 * one, -one, one)
    # Steps with one command keep it unlimited: a drive effect may raise the limit.
    np.testing.assert_allclose(mean_commands(limited), [3.0, 0.5, -3.0, -3.0])


def test_each_segment_gets_the_means_of_its_own_commands_start_and_limits() -> None:
    given = segment("", [3.0, -3.0], [0.0, 1.75 * STEP])
    moved = replace(given, initial_position=np.ones(1))
    later = replace(given, start=0.5 * STEP)
    other = replace(given, command=-given.command)
    segments = [given, moved, later, other]
    four = np.ones((4, 1))
    least = -four * [[9.0], [9.0], [9.0], [1.0]]
    held = CommandsOverSteps(segments, STEP, 0.0 * four, least, 9.0 * four)
    none = np.zeros((4, 1))
    found = held.means(np.arange(4), none, 3, none.astype(np.int64), STEP)[:, :, 0]
    np.testing.assert_allclose(found[0], [3.0, 1.5, -3.0])
    np.testing.assert_array_equal(found[1], found[0])
    np.testing.assert_allclose(found[2], [3.0, -1.5, -3.0])
    # This segment's lower limit is -1, so -3 counts as -1 in the mean.
    np.testing.assert_allclose(found[3], [-3.0, 0.0, 3.0], atol=1e-12)


@pytest.mark.parametrize(
    ("drive", "least", "greatest"),
    [
        ("", -1e9, 1e9),  # without a limit
        ('gear="2" forcerange="-3 5" forcelimited="true"', -6.0, 10.0),
        ('gear="2" ctrlrange="-1 2" ctrllimited="true"', -2.0, 4.0),
        ('ctrlrange="-1 9" ctrllimited="true" forcerange="-3 5" forcelimited="true"', -1.0, 5.0),
    ],
)
def test_command_range_combines_control_range_force_range_and_gear(
    drive: str, least: float, greatest: float
) -> None:
    """Commands are joint torques, N*m; MJCF states limits on the motor side of the gear."""
    simulator = BatchSimulator([segment(drive, [1.0], [0.0])], ("j",), threads=1)
    found = simulator.models.command_range(np.array([0]))
    np.testing.assert_allclose(np.ravel(found), [least, greatest])


def test_a_command_reversal_within_a_step_matches_a_simulation_with_finer_steps() -> None:
    given = segment('ctrlrange="-1 1" ctrllimited="true"', [3.0, -3.0], [0.0, 1.75 * STEP])
    coarse, fine = (
        BatchSimulator([given], ("j",), threads=1, refine=n).simulate(np.array([0]), {})[0]
        for n in (1, 100)
    )
    np.testing.assert_allclose(coarse.velocity[2:], fine.velocity[2:], atol=1e-6)
    assert coarse.velocity[4, 0] == pytest.approx(STEP * (1.75 - 2.25))
