"""What a drive gives in a step in which its command changes."""

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


def means(held: CommandsOverSteps) -> FloatArray:
    """Of four steps."""
    none = np.zeros((1, 1))
    return held.means(np.array([0]), none, 4, none.astype(np.int64), STEP)[0, :, 0]


def test_a_mean_of_what_is_heeded_and_not_what_is_heeded_of_a_mean() -> None:
    """3 and -3, a quarter of a step apart: a drive that heeds 1 gives half of that in the mean."""
    given = segment("", [3.0, -3.0], [0.0, 1.75 * STEP])
    one = np.ones((1, 1))
    free = CommandsOverSteps([given], STEP, 0.0 * one, -np.inf * one, np.inf * one)
    np.testing.assert_allclose(means(free), [3.0, 1.5, -3.0, -3.0])
    limited = CommandsOverSteps([given], STEP, 0.0 * one, -one, one)
    # Whole steps keep their command: a law of the drive may let more of it through.
    np.testing.assert_allclose(means(limited), [3.0, 0.5, -3.0, -3.0])


def test_segments_that_are_commanded_alike_are_told_from_those_that_are_not() -> None:
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
    # Of -3 and 3, the one is heeded as -1.
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
def test_what_a_drive_heeds(drive: str, least: float, greatest: float) -> None:
    """Commands are of the joint, N*m; limits in MJCF before the gear."""
    simulator = BatchSimulator([segment(drive, [1.0], [0.0])], ("j",), threads=1)
    found = simulator.models.command_range(np.array([0]))
    np.testing.assert_allclose(np.ravel(found), [least, greatest])


def test_a_step_in_which_a_limited_command_turns_moves_as_finer_steps_do() -> None:
    given = segment('ctrlrange="-1 1" ctrllimited="true"', [3.0, -3.0], [0.0, 1.75 * STEP])
    coarse, fine = (
        BatchSimulator([given], ("j",), threads=1, refine=n).simulate(np.array([0]), {})[0]
        for n in (1, 100)
    )
    np.testing.assert_allclose(coarse.velocity[2:], fine.velocity[2:], atol=1e-6)
    assert coarse.velocity[4, 0] == pytest.approx(STEP * (1.75 - 2.25))
