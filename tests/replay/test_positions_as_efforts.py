"""Commands of a format that does not state their kind, of a model whose actuators are motors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from replay_trials import recording, series
from test_trial_alignment import STRUCTURE

from pytest_twin.errors import RecordingError
from pytest_twin.recording_options import NO_OPTIONS
from pytest_twin.trial import Trial, make_trial

TIME = np.arange(300) * 0.01
MOTORS = replace(STRUCTURE, joint_inputs={"pan": ("effort",), "rail": ("effort",)})
MOTION = np.column_stack([np.sin(4.0 * TIME), 0.1 + 0.05 * np.cos(3.0 * TIME)])


def made(commands: np.ndarray, positions: np.ndarray = MOTION, **options: str) -> Trial:
    unstated = {"position": commands, "velocity": commands, "effort": commands}
    return make_trial(
        recording(
            series("/joint_states", ("pan", "rail"), TIME, position=positions),
            series("/joint_commands", ("pan", "rail"), TIME, **unstated),
        ),
        MOTORS,
        replace(NO_OPTIONS, **options),
    )


@pytest.mark.parametrize("late", [0, 2])
def test_commands_that_the_joints_follow_are_no_efforts(late: int) -> None:
    with pytest.raises(RecordingError) as caught:
        made(MOTION, MOTION[np.maximum(np.arange(300) - late, 0)])
    assert str(caught.value).startswith(
        "made.mcap: /joint_commands: the model's motors take efforts, but the commands are "
        "followed as positions (got "
    )
    assert str(caught.value).endswith(
        "% of their motion (RMS)'; expected a model with position servos; or command_mode: effort, "
        "if these are efforts)"
    )


def test_a_declared_mode_is_believed() -> None:
    assert made(MOTION, command_mode="effort").command_modes == ("effort", "effort")


def test_commands_of_another_course_are_efforts() -> None:
    # Gravity, inertia and friction of a pendulum that makes this motion.
    efforts = 0.8 * np.sin(MOTION) + 0.1 * np.gradient(np.gradient(MOTION, TIME, axis=0), axis=0)
    efforts += 0.3 * np.sign(np.gradient(MOTION, axis=0))
    assert made(efforts).command_modes == ("effort", "effort")


def test_one_joint_that_does_not_follow_shows_efforts() -> None:
    assert made(np.column_stack([MOTION[:, 0], 2.0 * MOTION[:, 1]])).command_mode == "effort"


def test_joints_at_rest_show_nothing() -> None:
    rest = np.zeros_like(MOTION)
    assert made(rest, rest).command_modes == ("effort", "effort")
