"""Trials from LeRobot data sets and CSV files, and the choice of topics."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from replay_trials import ARM, series

from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.errors import FormatError, RecordingError
from pytest_twin.formats.recording import TOPICS, Recording, Topic
from pytest_twin.formats.recordings.candidates import pairs, topics_option, what_to_do
from pytest_twin.realization import Realization, load
from pytest_twin.recording_options import JointNames, RecordingOptions
from pytest_twin.trial import make_trial, recordings_at

sys.path.insert(0, str(Path(__file__).parents[1] / "formats"))
from lerobot_files import episode, write_dataset

JOINTS = ("shoulder", "elbow")
NAMES = ["shoulder.pos", "elbow.pos"]


@pytest.fixture
def arm(tmp_path: Path) -> Realization:
    (tmp_path / "arm.xml").write_text(ARM)
    return load(tmp_path / "arm.xml")


def small_motion(number: int, frames: int = 120) -> dict[str, np.ndarray]:
    """Motion within the arm's joint range."""
    found = episode(number, frames)
    return {**found, "state": 0.1 * found["state"], "action": 0.1 * found["action"]}


def test_episodes_become_trials_and_whole_episodes_are_held_out(
    tmp_path: Path, arm: Realization
) -> None:
    dataset = write_dataset(tmp_path / "set", [small_motion(n) for n in range(5)], names=NAMES)
    found = read_trials([dataset], [], TOPICS, arm.structure)
    assert len(found.fit) + len(found.held_out) == 5
    assert len(found.held_out) == 1
    names = {trial.path.name for trial in (*found.fit, *found.held_out)}
    assert names == {f"episode_00000{n}" for n in range(5)}
    assert {trial.command_mode for trial in found.fit} == {"position"}


def test_only_the_named_episodes_of_a_data_set_are_read(tmp_path: Path, arm: Realization) -> None:
    dataset = write_dataset(tmp_path / "set", [small_motion(n) for n in range(5)], names=NAMES)
    found = read_trials([dataset], [], TOPICS, arm.structure, episodes={dataset: {1, 3}})
    names = {trial.path.name for trial in (*found.fit, *found.held_out)}
    assert names == {"episode_000001", "episode_000003"}


def test_an_unreadable_data_set_is_an_error_even_if_episodes_are_named(
    tmp_path: Path, arm: Realization
) -> None:
    dataset = write_dataset(tmp_path / "set", [small_motion(0), small_motion(1)], names=NAMES)
    (dataset / "meta" / "info.json").write_text("{")
    with pytest.raises(FormatError, match="not JSON"):
        read_trials([dataset], [], TOPICS, arm.structure, episodes={dataset: {1}})


def test_an_unusable_episode_is_left_out_with_a_note(tmp_path: Path, arm: Realization) -> None:
    episodes = [small_motion(0), small_motion(1), small_motion(2)]
    episodes[1]["state"] = np.full_like(episodes[1]["state"], np.inf)
    dataset = write_dataset(tmp_path / "set", episodes, names=NAMES)
    found = read_trials([dataset], [], TOPICS, arm.structure)
    assert len(found.fit) + len(found.held_out) == 2
    assert any(note.startswith("left out: ") and "episode_000001" in note for note in found.notes)


def test_unnamed_values_follow_the_order_of_the_models_actuators(
    tmp_path: Path, arm: Realization
) -> None:
    dataset = write_dataset(tmp_path / "set", [small_motion(0)], names=None)
    (recording,) = recordings_at(dataset, TOPICS)
    trial = make_trial(recording, arm.structure)
    assert trial.joints == trial.command_joints == JOINTS
    assert any(
        "taken in the order of the model's actuators: shoulder, elbow" in n for n in trial.notes
    )
    turned = RecordingOptions(joints=JointNames(names={"0": "elbow", "1": "shoulder"}))
    exchanged = make_trial(recording, arm.structure, turned)
    assert exchanged.joints == JOINTS
    assert np.array_equal(exchanged.position, trial.position[:, ::-1])


def test_more_unnamed_values_than_actuators_are_refused(tmp_path: Path, arm: Realization) -> None:
    wide = {key: np.tile(v, 2) if v.ndim == 2 else v for key, v in small_motion(0).items()}
    dataset = write_dataset(tmp_path / "set", [wide], names=None)
    (recording,) = recordings_at(dataset, TOPICS)
    with pytest.raises(RecordingError, match="the model has none of these joints"):
        make_trial(recording, arm.structure)


def test_commands_without_a_quantity_take_the_mode_of_the_actuator(
    tmp_path: Path, arm: Realization
) -> None:
    rows = "".join(f"{k / 100},{k / 1000},0,{k / 900},0\n" for k in range(100))
    heads = "time,shoulder.position,elbow.position,shoulder.command,elbow.command\n"
    (tmp_path / "log.csv").write_text(heads + rows)
    (recording,) = recordings_at(tmp_path / "log.csv", TOPICS)
    trial = make_trial(recording, arm.structure)
    inputs = [arm.structure.joint_inputs[joint][0] for joint in trial.command_joints]
    assert list(trial.command_modes) == inputs


# -- suggested topics ---------------------------------------------------------------------

STATE = "sensor_msgs/msg/JointState"
CONTROLLER = "control_msgs/msg/JointTrajectoryControllerState"
BOTH = ("state", "command")


def recording(*topics: Topic, **read: str) -> Recording:
    time = np.arange(5) * 0.1
    found = {
        role: series(topic, JOINTS, time, position=np.zeros((5, 2))) for role, topic in read.items()
    }
    return Recording(Path("bag"), found, {}, (), (), topics)


def options(given: Recording) -> list[str]:
    return [topics_option(*pair) for pair in pairs(given)]


def test_the_most_likely_pair_of_topics_is_suggested_first() -> None:
    given = recording(
        Topic("/arm/commands", "std_msgs/msg/Float64MultiArray", 9, ("command",), ("0", "1"), ()),
        Topic("/arm/controller_state", CONTROLLER, 9, BOTH, JOINTS, ("position",)),
        Topic("/arm/joint_states", STATE, 9, BOTH, JOINTS, ("position", "velocity")),
        Topic("/wheels/joint_states", STATE, 9, BOTH, ("left", "right"), ("position",)),
    )
    found = options(given)
    assert found[0] == "--topics state=/arm/joint_states,command=/arm/commands"
    assert "--topics state=/arm/controller_state,command=/arm/controller_state" in found
    assert "--topics state=/arm/joint_states,command=/arm/controller_state" in found
    assert not any("/wheels" in option and "/arm/joint" in option for option in found)


def test_suggestions_keep_a_topic_that_was_already_read() -> None:
    given = recording(
        Topic("/joint_states", STATE, 9, BOTH, JOINTS, ("position",)),
        Topic("/left/joint_states", STATE, 9, BOTH, JOINTS, ("position",)),
        Topic("/goal", "trajectory_msgs/msg/JointTrajectory", 2, ("command",), JOINTS, ()),
        state="/joint_states",
    )
    assert options(given)[0] == "--topics state=/joint_states,command=/goal"
    assert all("state=/joint_states" in option for option in options(given))


@pytest.mark.parametrize(
    ("topics", "words"),
    [
        ((), "commands in the file: a topic, or columns NAME.command of a CSV file"),
        ((Topic("/tf", "tf2_msgs/msg/TFMessage", 3),), "a topic with joints; it has /tf"),
        (
            (Topic("/c", STATE, 3, BOTH, tuple("abcdefgh"), ("position",)),),
            "/c (3 sensor_msgs/msg/JointState of a, b, c, d, e, f and 2 more)",
        ),
    ],
)
def test_the_message_without_commands_says_what_the_file_contains(
    topics: tuple[Topic, ...], words: str
) -> None:
    assert what_to_do(recording(*topics), "command") == words
