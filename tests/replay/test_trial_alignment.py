"""Conversion of a recording into a trial: common clock, data quality marks, precise errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from replay_trials import START_NS, recording, series

from pytest_twin.dependency import Structure
from pytest_twin.errors import RecordingError
from pytest_twin.formats.mcap import Damage, Recording
from pytest_twin.trial import make_trial

JOINTS = ("pan", "rail")
STRUCTURE = Structure(
    realization="mujoco",
    body_parent={"a": "world", "b": "a"},
    joint_body={"pan": "a", "rail": "b"},
    joint_range={"pan": (-1.5, 1.5), "rail": (0.0, 0.2)},
    joint_type={"pan": "hinge", "rail": "slide"},
    frame_body={},
    actuator_joints={},
    collision_bodies=frozenset(),
    couplings={},
    part_ids=frozenset(),
)


def clean_recording(count: int = 200, **changed: object) -> Recording:
    """A recording at 100 Hz of two joints that follow their commands with an error of 0.1 mrad."""
    time = np.arange(count) * 0.01
    command = np.column_stack([np.sin(time), 0.1 + 0.05 * np.cos(time)])
    state = {"position": command - 1e-4, "velocity": np.zeros((count, 2)), "effort": None}
    state |= {key: value for key, value in changed.items() if key in state}
    order = changed.get("command", {"position": command})
    return recording(
        series("/joint_states", JOINTS, changed.get("time", time), **state),  # type: ignore[arg-type]
        series("/joint_commands", JOINTS, changed.get("command_time", time), **order),  # type: ignore[arg-type]
        {"role": "fit", "controller": "kp1"},
    )


def test_trial_time_starts_at_the_first_state() -> None:
    time = np.arange(50) * 0.02
    made = make_trial(clean_recording(50, time=time + 0.5, command_time=time + 0.3), STRUCTURE)
    assert made.time[0] == 0.0
    assert made.time[-1] == pytest.approx(0.98, abs=1e-12)
    assert made.command_time[0] == pytest.approx(-0.2, abs=1e-12)
    assert made.start == START_NS + 500_000_000
    assert made.stamps[-1] == START_NS + 1_480_000_000
    assert made.command_mode == "position"
    assert made.metadata == {"role": "fit", "controller": "kp1"}
    assert made.marks == ()


@given(
    st.integers(1, 2**40), st.lists(st.integers(0, 10**12), min_size=2, max_size=50, unique=True)
)
def test_absolute_stamps_are_kept_exactly(first: int, offsets: list[int]) -> None:
    stamp = np.sort(np.array(offsets, dtype=np.int64)) + first
    fields = {"position": np.zeros((len(stamp), 1)), "velocity": None, "effort": None}
    state = series("/joint_states", ("pan",), np.arange(len(stamp)), **fields)
    command = series("/joint_commands", ("pan",), np.arange(len(stamp)), **fields)
    made = make_trial(
        recording(
            replace(state, stamp=stamp, log_time=stamp),
            replace(command, stamp=stamp, log_time=stamp),
        )
    )
    assert np.array_equal(made.stamps, stamp)


def test_unordered_and_duplicate_stamps_are_sorted_and_marked() -> None:
    time = np.arange(200) * 0.01
    time[[50, 51]] = time[[51, 50]]
    time[100] = time[99]
    made = make_trial(clean_recording(time=time), STRUCTURE)
    assert (np.diff(made.time) >= 0).all()
    assert {(mark.kind, round(mark.start, 3)) for mark in made.marks} == {
        ("unordered_stamp", 0.5),
        ("duplicate_stamp", 0.99),
    }
    assert made.position[50, 0] == pytest.approx(np.sin(0.51) - 1e-4)
    assert len(made.time) == 200
    assert not any("have the stamp of the one before" in note for note in made.notes)


def test_many_samples_with_one_stamp_are_said() -> None:
    """Stamps in whole hundredths of a log at 200 Hz."""
    time = np.floor(np.arange(200) / 2.0) * 0.01
    made = make_trial(clean_recording(time=time), STRUCTURE)
    (note,) = (note for note in made.notes if "have the stamp of the one before" in note)
    assert note.startswith("/joint_states: 100 of 200 samples")
    assert note.endswith("wrong by an interval (10 ms)")


@pytest.mark.parametrize(("ahead", "word"), [(0.3, "later"), (-0.3, "earlier")])
def test_stamps_of_two_clocks_are_said(ahead: float, word: str) -> None:
    """Commands of a second computer, whose clock differs; both arrive within some ms."""
    whole = clean_recording()
    state, command = whole.series["state"], whole.series["command"]
    late = np.random.default_rng(1).integers(0, 8_000_000, len(state.stamp))
    stamp = command.stamp + int(ahead * 1e9)
    states = replace(state, log_time=np.sort(state.stamp + late))
    shifted = replace(command, stamp=stamp, log_time=np.sort(command.stamp + late))
    made = make_trial(recording(states, shifted))
    (note,) = (note for note in made.notes if "two computers whose clocks differ" in note)
    assert f"0.3 s {word} than those of /joint_states" in note
    equal = replace(command, log_time=np.sort(command.stamp + late))
    made = make_trial(recording(states, equal))
    assert not any("whose clocks differ" in note for note in made.notes)


def test_the_last_of_several_commands_with_one_stamp_applies() -> None:
    time = np.arange(200) * 0.01
    twice = time.copy()
    twice[100] = twice[99]
    made = make_trial(clean_recording(command_time=twice))
    last = np.searchsorted(made.command_time, 0.9901, side="right") - 1
    assert made.command[last, 0] == pytest.approx(np.sin(1.0))


def test_gaps_are_marked_on_their_topic() -> None:
    time = np.arange(200) * 0.01
    time[120:] += 0.3
    (mark,) = make_trial(clean_recording(time=time), STRUCTURE).marks
    assert (mark.kind, mark.topic) == ("gap", "/joint_states")
    assert (mark.start, mark.end) == pytest.approx((1.19, 1.5))
    assert mark.text == "no message for 0.31 s, usually 0.01 s"


def test_outliers_are_marked_and_kept() -> None:
    position = clean_recording().series["state"].position
    assert position is not None
    spiked = position.copy()
    spiked[77, 0] += 0.6
    made = make_trial(clean_recording(position=spiked), STRUCTURE)
    assert [(m.kind, m.joint) for m in made.marks] == [("outlier", "pan")]
    assert made.position[77, 0] == spiked[77, 0]
    assert np.flatnonzero(made.marked("pan", ["outlier"])).tolist() == [77]
    assert not made.marked("rail", ["outlier"]).any()


def test_steps_and_quantized_encoders_are_not_marked_as_outliers() -> None:
    position = np.round(np.column_stack([np.sin(np.arange(200) * 0.01), np.full(200, 0.1)]), 2)
    position[100:, 1] = 0.15
    assert make_trial(clean_recording(position=position), STRUCTURE).marks == ()


def test_a_constant_reading_under_a_moving_command_is_marked_as_stuck() -> None:
    count = 400
    position = np.column_stack([np.sin(np.arange(count) * 0.01) + 1e-4, np.full(count, 0.1)])
    position[100:250, 0] = position[100, 0]
    (mark,) = make_trial(clean_recording(count, position=position), STRUCTURE).marks
    assert (mark.kind, mark.joint) == ("stuck", "pan")
    assert (mark.start, mark.end) == pytest.approx((1.0, 2.49))
    assert "stays at 0.841571 rad while its command moves" in mark.text


def test_file_damage_becomes_a_mark_of_the_trial() -> None:
    torn = replace(clean_recording(), damage=(Damage("byte 4711", "3 messages"),))
    (mark,) = make_trial(torn).marks
    assert (mark.kind, mark.text) == ("damage", "byte 4711: 3 messages")


def test_an_empty_velocity_field_is_not_a_measurement() -> None:
    empty = np.full((200, 2), np.nan)
    assert make_trial(clean_recording(velocity=empty)).velocity is None
    half = empty.copy()
    half[:, 0] = 0.0
    made = make_trial(clean_recording(velocity=half))
    assert made.velocity is not None
    assert np.isnan(made.velocity[:, 1]).all()
    assert [(m.kind, m.joint) for m in made.marks] == [("unavailable", "rail")]


def test_a_joint_without_command_values_is_left_out_of_the_commands() -> None:
    command = np.column_stack([np.sin(np.arange(200) * 0.01), np.full(200, np.nan)])
    made = make_trial(clean_recording(command={"position": command}), STRUCTURE)
    assert made.command_joints == ("pan",)
    assert made.command.shape == (200, 1)
    assert [(m.kind, m.joint) for m in made.marks] == [("unavailable", "rail")]


def test_the_filled_command_field_defines_the_command_mode() -> None:
    made = make_trial(clean_recording(command={"effort": np.ones((200, 2))}), STRUCTURE)
    assert made.command_mode == "effort"


def positions_with_value(row: int, column: int, value: float) -> np.ndarray:
    position = clean_recording().series["state"].position
    assert position is not None
    position = position.copy()
    position[row, column] = value
    return position


ERRORS: dict[str, tuple[Callable[[], Recording], str]] = {
    "no command": (
        lambda: recording(clean_recording().series["state"], None),
        "made.mcap: command: no command messages (expected commands in the file: a topic, or "
        "columns NAME.command of a CSV file; topics are mapped in twin.yaml or by "
        "--topics state=/x,command=/y)",
    ),
    "nothing left": (
        lambda: replace(
            recording(clean_recording().series["state"], None),
            damage=(Damage("byte 120", "a chunk that ends early"),),
        ),
        "made.mcap: command: no command messages in what could be read of a damaged file "
        "(got 'byte 120: a chunk that ends early'; expected a whole recording)",
    ),
    "no position": (
        lambda: clean_recording(position=None),
        "made.mcap: /joint_states: no state has positions (expected positions of the joints in "
        "each state, rad or m)",
    ),
    "infinite position": (
        lambda: clean_recording(position=positions_with_value(70, 1, np.inf)),
        "made.mcap: /joint_states joint 'rail': position is not finite in 1 of 200 messages "
        "(got 'inf at 0.7 s'; expected a finite number of m)",
    ),
    "NaN throughout": (
        lambda: clean_recording(position=np.full((200, 2), np.nan)),
        "made.mcap: /joint_states: no position is a number (got 'NaN throughout'; expected "
        "measured positions)",
    ),
    "infinite velocity": (
        lambda: clean_recording(velocity=np.full((200, 2), np.inf)),
        "made.mcap: /joint_states joint 'pan': velocity is not finite in 200 of 200 messages "
        "(got 'inf at 0 s'; expected a finite number of rad/s)",
    ),
    "two fields": (
        lambda: clean_recording(
            command={"position": np.ones((200, 2)), "effort": np.ones((200, 2))}
        ),
        "made.mcap: /joint_commands: commands of joint 'pan' fill position and effort, and no "
        "actuator of it says which (expected --command-mode pan=position, or 'command_mode:' in "
        "twin.yaml)",
    ),
    "empty commands": (
        lambda: clean_recording(command={"position": np.full((200, 2), np.nan)}),
        "made.mcap: /joint_commands: no command has a value (got 'position, velocity and effort "
        "are empty'; expected the field that the controller mode uses)",
    ),
    "no overlap": (
        lambda: clean_recording(command_time=np.arange(200) * 0.01 + 3600.0),
        "made.mcap: /joint_commands: commands and states do not overlap in time (got 'commands "
        "from 3600 to 3601.99 s, states from 0 to 1.99' s; expected one clock; log times do not "
        "either)",
    ),
    "degrees": (
        lambda: clean_recording(position=np.rad2deg(np.tile([[0.9, 0.001]], (200, 1)))),
        "made.mcap: /joint_states joint 'pan': positions far beyond the joint's range, as if in "
        "degrees (got '51.5662' rad; expected the model's range, -1.5 to 1.5 rad; --units deg "
        "reads degrees)",
    ),
    "encoder counts": (
        lambda: clean_recording(command={"position": np.tile([[2048.0, 0.1]], (200, 1))}),
        "made.mcap: /joint_commands joint 'pan': positions far beyond the joint's range, as if in "
        "encoder counts (got '2048' rad; expected the model's range, -1.5 to 1.5 rad)",
    ),
    "millimetres": (
        lambda: clean_recording(position=np.tile([[0.1, 150.0]], (200, 1))),
        "made.mcap: /joint_states joint 'rail': positions far beyond the joint's range, as if in "
        "mm (got '150' m; expected the model's range, 0 to 0.2 m)",
    ),
}


@pytest.mark.parametrize("name", ERRORS)
def test_an_unusable_recording_is_refused_with_the_reason(name: str) -> None:
    made, words = ERRORS[name]
    with pytest.raises(RecordingError) as refusal:
        make_trial(made(), STRUCTURE)
    assert str(refusal.value) == words


def test_a_joint_that_the_model_lacks_is_left_out_with_a_note() -> None:
    state = replace(clean_recording().series["state"], names=("pan", "wheel"))
    made = make_trial(recording(state, clean_recording().series["command"]), STRUCTURE)
    assert made.joints == ("pan",)
    assert made.position.shape == (200, 1)
    assert made.notes == (
        "/joint_states: left out, not in the model: wheel; of the model not recorded: rail",
    )


def test_a_recording_of_another_robot_is_refused_with_the_models_joint_names() -> None:
    state = replace(clean_recording().series["state"], names=("hip", "wrist"))
    with pytest.raises(RecordingError) as refusal:
        make_trial(recording(state, clean_recording().series["command"]), STRUCTURE)
    assert str(refusal.value) == (
        "made.mcap: /joint_states: the model has none of these joints (got 'hip, wrist'; expected "
        "one of pan, rail; --joints RECORDED=MODEL,... or 'joints:' in twin.yaml maps names)"
    )
    with pytest.raises(RecordingError, match="expected a model with joints"):
        make_trial(
            recording(state, clean_recording().series["command"]),
            replace(STRUCTURE, joint_type={}, joint_range={}),
        )


def test_positions_slightly_outside_the_joint_range_are_only_marked() -> None:
    position = clean_recording().series["state"].position
    assert position is not None
    position = position + np.array([0.0, 0.06])
    (mark,) = make_trial(clean_recording(position=position), STRUCTURE).marks
    assert (mark.kind, mark.joint) == ("beyond_range", "rail")
    assert mark.text == "outside the model's range, 0 to 0.2 m in 65 messages"


def test_a_single_command_shortly_before_the_first_state_is_kept() -> None:
    command = {"position": np.full((1, 2), 0.1)}
    made = make_trial(clean_recording(command_time=np.array([-0.4]), command=command), STRUCTURE)
    assert made.command_time[0] == pytest.approx(-0.4)
