"""Irregular recordings from real drivers: each is read by a rule stated in the trial's notes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from replay_trials import START_NS, recording, series

from pytest_twin.dependency import Structure
from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import Damage, JointSeries, Recording
from pytest_twin.recording_options import JointNames, RecordingOptions
from pytest_twin.trial import Trial, make_trial, make_trials
from pytest_twin.trial.common_stamps import resample_to_common_stamps

COUNT = 400
TIME = 0.01 * np.arange(COUNT)
MOTION = np.column_stack([0.8 * np.sin(3.0 * TIME), 0.5 * np.cos(2.0 * TIME)])
SENT = MOTION + 0.002
"""rad. Commands; the joints follow with an error, because they are measured."""


def structure(
    inputs: Mapping[str, tuple[str, ...]] | None = None, joints: tuple[str, ...] = ("j1", "j2")
) -> Structure:
    """The structure of an arm; ``inputs`` are the actuator inputs per joint (default position)."""
    return Structure(
        realization="mujoco",
        body_parent=dict.fromkeys(joints, "world"),
        joint_body={j: j for j in joints},
        joint_range=dict.fromkeys(joints),
        joint_type=dict.fromkeys(joints, "hinge"),
        frame_body={},
        actuator_joints={},
        collision_bodies=frozenset(),
        couplings={},
        part_ids=frozenset(),
        joint_inputs=inputs or dict.fromkeys(joints, ("position",)),
    )


def states(names: tuple[str, ...] = ("j1", "j2"), **fields: np.ndarray) -> JointSeries:
    return series("/joint_states", names, TIME, **({"position": MOTION} | fields))


def commands(names: tuple[str, ...] = ("j1", "j2"), **fields: np.ndarray) -> JointSeries:
    return series("/joint_commands", names, TIME, **(fields or {"position": SENT}))


def split_messages(one: JointSeries, late: float) -> JointSeries:
    """Each message split in two: the first joint, then ``late`` s later the second joint."""
    position = np.full((2 * len(one.stamp), 2), np.nan)
    assert one.position is not None
    position[::2, 0], position[1::2, 1] = one.position.T
    stamp = np.repeat(one.stamp, 2)
    stamp[1::2] += round(late * 1e9)
    return replace(one, stamp=stamp, log_time=stamp, position=position)


def with_stamps(one: JointSeries, stamp: np.ndarray) -> JointSeries:
    return replace(one, stamp=stamp.astype(np.int64))


def note(trial: Trial, words: str) -> str:
    (found,) = [n for n in trial.notes if words in n]
    return found


# -- joints


def test_recorded_joints_that_the_model_lacks_are_left_out_with_a_note() -> None:
    names = ("wheel_l", "j1", "j2", "wheel_r")
    wide = np.column_stack([TIME, MOTION, TIME])
    made = make_trial(recording(states(names, position=wide), commands()), structure())
    assert made.joints == ("j1", "j2")
    assert np.array_equal(made.position, MOTION)
    assert made.notes == ("/joint_states: left out, not in the model: wheel_l, wheel_r",)


@pytest.mark.parametrize(
    "names",
    [
        JointNames(prefix="left_"),
        JointNames.of({"prefix": "left_"}),
        JointNames.of({"left_j1": "j1", "left_j2": "j2"}),
    ],
)
def test_a_prefix_of_recorded_joint_names_is_removed(names: JointNames) -> None:
    made = make_trial(
        recording(states(("left_j1", "left_j2")), commands(("left_j1", "left_j2"))),
        structure(),
        RecordingOptions(joints=names),
    )
    assert (made.joints, made.command_joints) == (("j1", "j2"), ("j1", "j2"))


def test_a_suffix_of_model_joint_names_is_added() -> None:
    made = make_trial(
        recording(states(), commands()),
        structure(joints=("j1_joint", "j2_joint")),
        RecordingOptions(joints=JointNames(suffix="_joint")),
    )
    assert made.joints == ("j1_joint", "j2_joint")


def test_the_error_suggests_a_prefix_when_no_joint_name_matches() -> None:
    names = ("left_j1", "left_j2")
    with pytest.raises(RecordingError) as refusal:
        make_trial(recording(states(names), commands(names)), structure())
    assert str(refusal.value) == (
        "made.mcap: /joint_states: the model has none of these joints (got 'left_j1, left_j2'; "
        "expected one of j1, j2; in twin.yaml joints: {prefix: left_}, or --joints prefix=left_)"
    )


def test_two_recorded_joints_may_not_map_to_one_model_joint() -> None:
    names = ("j1", "left_j1")
    with pytest.raises(RecordingError, match="two recorded joints become 'j1' of the model"):
        make_trial(
            recording(states(names), commands()),
            structure(),
            RecordingOptions(joints=JointNames(prefix="left_")),
        )


# -- separate messages


def test_messages_of_different_joints_with_equal_stamps_are_merged() -> None:
    made = make_trial(
        recording(split_messages(states(), 0.0), split_messages(commands(), 0.0)), structure()
    )
    assert np.array_equal(made.position, MOTION)
    assert made.is_dense
    assert "800 messages of different joints and one stamp taken together" in note(made, "together")
    assert np.array_equal(made.setpoint.at(made.time), SENT)
    assert not any("the stamp of the one before" in said for said in made.notes)


def test_joints_with_different_stamps_keep_their_own_samples() -> None:
    made = make_trial(recording(split_messages(states(), 0.005), commands()), structure())
    # The first state carries the latest sample of each joint.
    assert made.time[:3] == pytest.approx([0.0, 0.005, 0.01])
    assert made.position[0] == pytest.approx([MOTION[0, 0], MOTION[0, 1]])
    assert np.isnan(made.position[1, 1])
    assert made.position[2, 1] == MOTION[1, 1]
    assert np.isnan(made.position[2, 0])
    assert not any(m.kind == "gap" for m in made.marks)
    assert "joints come in separate messages (j1 in 400, j2 in 400 of 800)" in note(
        made, "separate"
    )


def test_the_diagnosis_interpolates_all_joints_to_one_joints_stamps_with_a_note() -> None:
    whole = make_trial(recording(split_messages(states(), 0.005), commands()), structure())
    made = resample_to_common_stamps(whole)
    assert made.is_dense
    at = made.time + 0.005
    assert np.abs(made.position[1:-1, 0] - 0.8 * np.sin(3.0 * at[1:-1])).max() < 2e-5
    assert "interpolated there, from samples at most 5 ms away" in made.notes[-1]


def test_a_trial_with_all_joints_in_each_message_is_not_resampled() -> None:
    made = make_trial(recording(states(), commands()), structure())
    assert resample_to_common_stamps(made) is made


def test_a_command_message_for_one_joint_keeps_the_other_joints_command() -> None:
    made = make_trial(recording(states(), split_messages(commands(), 0.004)), structure())
    for at in (0.5, 1.234, 3.7):
        (sent,) = made.commands_before(np.array([at]))
        assert sent[0] == SENT[int(np.floor(at / 0.01 + 1e-6)), 0]
        assert sent[1] == SENT[int(np.floor((at - 0.004) / 0.01 + 1e-6)), 1]
    assert not any(m.kind == "gap" for m in made.marks)


def test_a_joint_recorded_at_a_lower_rate_keeps_its_own_samples() -> None:
    names = ("j1", "j2", "gripper")
    position = np.column_stack([MOTION, np.where(np.arange(COUNT) % 5 == 0, 0.1 * TIME, np.nan)])
    made = make_trial(
        recording(states(names, position=position), commands()), structure(joints=names)
    )
    assert made.position[5, 2] == pytest.approx(0.005)
    assert np.isnan(made.position[6, 2])
    slow = resample_to_common_stamps(made)
    assert len(slow.time) == COUNT // 5
    assert np.array_equal(slow.position[:, :2], MOTION[::5])


def test_leading_states_without_positions_are_left_out() -> None:
    position = MOTION.copy()
    position[:12] = np.nan
    made = make_trial(recording(states(position=position), commands()), structure())
    assert made.start == START_NS + 120_000_000
    assert len(made.time) == COUNT - 12
    assert "12 messages without a position of these joints left out" in note(made, "without")


def test_a_nan_position_is_marked_as_unavailable() -> None:
    position = MOTION.copy()
    position[70, 1] = np.nan
    made = make_trial(recording(states(position=position), commands()), structure())
    assert [(m.kind, m.joint, m.text) for m in made.marks] == [
        ("unavailable", "j2", "position is not filled in 1 message")
    ]
    assert len(resample_to_common_stamps(made).time) == COUNT - 1


def test_two_publishers_with_different_positions_are_refused() -> None:
    position = MOTION.copy()
    position[::2] += 1.0
    with pytest.raises(RecordingError, match="two publishers send different positions"):
        make_trial(recording(states(position=position), commands()), structure())


def test_different_positions_of_one_joint_at_equal_stamps_are_refused() -> None:
    one = states()
    stamp = np.repeat(one.stamp, 2)
    position = np.repeat(MOTION, 2, axis=0)
    position[1::2] = 0.0
    with pytest.raises(RecordingError, match="different positions of one joint at the same stamps"):
        make_trial(
            recording(replace(one, stamp=stamp, log_time=stamp, position=position), commands()),
            structure(),
        )


def test_repeated_identical_messages_are_one_sample_with_a_note() -> None:
    one = states()
    stamp = np.repeat(one.stamp, 2)
    position = np.repeat(MOTION, 2, axis=0)
    made = make_trial(
        recording(replace(one, stamp=stamp, log_time=stamp, position=position), commands()),
        structure(),
    )
    assert made.marks == ()
    assert len(made.time) == len(one.stamp)
    assert made.notes[-1] == (
        "/joint_states: 800 messages repeat 400 samples, each about 2 times: the repeated ones are "
        "left out"
    )


# -- fields


@pytest.mark.parametrize(
    ("takes", "mode"), [("position", "position"), ("velocity", "velocity"), ("effort", "effort")]
)
def test_the_models_actuator_decides_which_command_field_is_used(takes: str, mode: str) -> None:
    both = commands(position=SENT, velocity=2.0 * SENT, effort=3.0 * SENT)
    made = make_trial(recording(states(), both), structure(dict.fromkeys(("j1", "j2"), (takes,))))
    assert made.command_mode == mode
    factor = {"position": 1.0, "velocity": 2.0, "effort": 3.0}[mode]
    assert np.array_equal(made.command, factor * SENT)
    assert f"{mode} commands count at j1, j2" in note(made, "count")


def test_each_joint_may_have_its_own_command_mode() -> None:
    nan = np.full(COUNT, np.nan)
    mixed = commands(
        position=np.column_stack([nan, SENT[:, 1]]), effort=np.column_stack([SENT[:, 0], nan])
    )
    made = make_trial(
        recording(states(), mixed), structure({"j1": ("effort",), "j2": ("position",)})
    )
    assert (made.command_mode, made.command_modes) == ("mixed", ("effort", "position"))
    assert np.array_equal(made.command, SENT)
    assert made.notes == ()


def test_effort_commands_of_a_position_servo_are_left_out_with_a_note() -> None:
    nan = np.full(COUNT, np.nan)
    mixed = commands(
        position=np.column_stack([nan, SENT[:, 1]]), effort=np.column_stack([SENT[:, 0], nan])
    )
    made = make_trial(recording(states(), mixed), structure())
    assert (made.command_joints, made.command_modes) == (("j2",), ("position",))
    assert made.notes == (
        "/joint_commands: effort commands of 'j1' are not used, the model has a position servo "
        "there, which is taken to hold the joint",
    )


def test_a_declared_command_mode_overrides_the_model() -> None:
    both = commands(position=SENT, velocity=MOTION)
    made = make_trial(
        recording(states(), both), structure(), RecordingOptions(command_mode={"j1": "velocity"})
    )
    assert made.command_modes == ("velocity", "position")
    with pytest.raises(RecordingError, match="effort commands of joint 'j1' are empty"):
        make_trial(recording(states(), both), structure(), RecordingOptions(command_mode="effort"))
    with pytest.raises(RecordingError, match="command_mode names a joint that is not commanded"):
        make_trial(
            recording(states(), both), structure(), RecordingOptions(command_mode={"hip": "effort"})
        )


def test_without_a_model_command_fields_that_are_all_zero_are_not_used() -> None:
    zero = np.zeros_like(MOTION)
    made = make_trial(recording(states(), commands(position=SENT, velocity=zero, effort=zero)))
    assert made.command_mode == "position"
    assert "the others are zero; not used: velocity and effort" in made.notes[0]


# -- clocks


def test_log_times_are_used_if_one_topic_has_zero_stamps() -> None:
    sent = commands()
    simulated = (sent.stamp - START_NS) + 12_000_000_000
    made = make_trial(
        recording(with_stamps(states(), simulated), with_stamps(sent, np.zeros(COUNT))), structure()
    )
    assert made.command_time == pytest.approx(TIME)
    assert note(made, "stamp") == (
        "/joint_commands: no message has a stamp: log times are used for both topics (--clock "
        "stamp to refuse)"
    )


def test_log_times_are_used_for_both_topics_if_one_is_unstamped() -> None:
    late = replace(states(), log_time=states().log_time + 30_000_000)
    bare = replace(commands(), stamped=False)
    made = make_trial(recording(late, bare), structure())
    assert made.command_time == pytest.approx(TIME - 0.03)
    assert "no message has a stamp: log times are used for both" in note(made, "stamp")


def test_two_unstamped_topics_give_one_note_about_log_times() -> None:
    bare = (replace(one, stamped=False) for one in (states(), commands()))
    assert make_trial(recording(*bare), structure()).notes == (
        "no message has a stamp: log times are used",
    )


def test_missing_stamps_are_not_reported_twice() -> None:
    stamp = states().stamp.copy()
    stamp[:20] = 0
    told = Damage("/joint_states", "20 messages without header.stamp, first message 0")
    torn = Damage("byte 4711", "3 messages")
    read = replace(
        recording(with_stamps(states(), stamp), with_stamps(commands(), stamp)), damage=(told, torn)
    )
    made = make_trial(read, structure())
    assert [(m.kind, m.text) for m in made.marks] == [("damage", "byte 4711: 3 messages")]


def test_simulated_time_is_kept_if_it_runs_at_half_speed() -> None:
    sent = commands()
    simulated = (sent.stamp - START_NS) // 2 + 12_000_000_000
    made = make_trial(
        recording(with_stamps(states(), simulated), with_stamps(sent, np.zeros(COUNT))), structure()
    )
    assert made.time == pytest.approx(0.5 * TIME)
    assert made.command_time == pytest.approx(0.5 * TIME, abs=1e-6)
    assert "runs at 0.5 times the recorder's" in note(made, "recorder's")


def test_log_times_are_used_if_stamps_of_states_and_commands_do_not_overlap() -> None:
    uptime = states().stamp - START_NS + 77_000_000_000
    sent = commands()
    sent = replace(sent, stamp=sent.stamp + 1_000_000)
    made = make_trial(recording(with_stamps(states(), uptime), sent), structure())
    assert made.command_time == pytest.approx(TIME)
    assert "stamps of states and commands do not overlap" in note(made, "overlap")
    with pytest.raises(RecordingError, match="--clock log takes the recorder's times"):
        make_trial(
            recording(with_stamps(states(), uptime), sent),
            structure(),
            RecordingOptions(clock="stamp"),
        )


def test_stamps_are_used_if_both_topics_have_them() -> None:
    late = replace(states(), log_time=states().log_time + 30_000_000)
    made = make_trial(recording(late, commands()), structure())
    assert made.command_time == pytest.approx(TIME)
    logged = make_trial(recording(late, commands()), structure(), RecordingOptions(clock="log"))
    assert logged.command_time == pytest.approx(TIME - 0.03)


def test_leading_messages_without_a_stamp_are_left_out() -> None:
    stamp = states().stamp.copy()
    stamp[:20] = 0
    made = make_trial(
        recording(with_stamps(states(), stamp), with_stamps(commands(), stamp)), structure()
    )
    assert made.start == START_NS + 200_000_000
    assert made.duration == pytest.approx(3.79)
    assert made.command_time[0] == pytest.approx(0.0)
    assert "/joint_states: 20 of 400 messages are left out, they have no stamp" in made.notes[0]


def test_stamps_may_start_at_time_zero() -> None:
    stamp = states().stamp - START_NS
    made = make_trial(
        recording(with_stamps(states(), stamp), with_stamps(commands(), stamp)), structure()
    )
    assert len(made.time) == COUNT
    assert made.notes == ()


def stamps_with_step(by: float, at: int = 200) -> np.ndarray:
    stamp = states().stamp.copy()
    stamp[at:] += round(by * 1e9)
    return stamp


@pytest.mark.parametrize("by", [-1.2, -0.1, 0.7])
def test_log_times_are_used_if_the_stamp_clock_jumps(by: float) -> None:
    made = make_trial(
        recording(
            with_stamps(states(), stamps_with_step(by)),
            with_stamps(commands(), stamps_with_step(by)),
        ),
        structure(),
    )
    assert np.array_equal(made.position, MOTION)
    assert made.time == pytest.approx(TIME)
    assert f"stamps step by {by + 0.01:.4g} s at message 200: log times" in note(made, "step")


def test_without_log_times_a_clock_jump_cuts_the_recording_in_two() -> None:
    frozen = np.full(COUNT, START_NS)
    read = recording(
        replace(states(), stamp=stamps_with_step(-1.2), log_time=frozen),
        replace(commands(), stamp=stamps_with_step(-1.2), log_time=frozen),
    )
    first, second = make_trials(read, structure())
    assert np.array_equal(first.position, MOTION[:200])
    assert np.array_equal(second.position, MOTION[200:])
    assert second.command_time == pytest.approx(TIME[:200])
    with pytest.raises(RecordingError, match="the clock steps back"):
        make_trial(read, structure())


def test_messages_out_of_order_are_sorted_by_stamp_and_marked() -> None:
    order = np.arange(COUNT)
    order[[50, 51, 52]] = [52, 50, 51]
    made = make_trial(
        recording(replace(states(position=MOTION[order]), stamp=states().stamp[order]), commands()),
        structure(),
    )
    assert np.array_equal(made.position, MOTION)
    assert [m.kind for m in made.marks] == ["unordered_stamp"]
    assert made.notes == ()


# -- missing data


def without(one: JointSeries, first: int, end: int) -> JointSeries:
    keep = np.ones(len(one.stamp), dtype=bool)
    keep[first:end] = False
    return replace(
        one,
        stamp=one.stamp[keep],
        log_time=one.log_time[keep],
        position=None if one.position is None else one.position[keep],
    )


@pytest.mark.parametrize("missing", [5, 30, 150])
def test_messages_missing_in_both_topics_cut_the_recording(missing: int) -> None:
    read = recording(without(states(), 150, 150 + missing), without(commands(), 150, 150 + missing))
    first, second = make_trials(read, structure())
    assert first.duration == pytest.approx(1.49)
    assert second.offset == pytest.approx(0.01 * (150 + missing))
    assert second.time[0] == 0.0
    assert second.command_time[0] == pytest.approx(0.0)
    assert np.array_equal(second.position[0], MOTION[150 + missing])
    assert (first.name, second.name) == (
        "made.mcap from 0 s", f"made.mcap from {second.offset:.4g} s"
    )  # fmt: skip
    assert f"missing from 1.49 to {second.offset:.4g} s" in note(first, "cut into 2 parts")
    assert not [m for m in (*first.marks, *second.marks) if m.kind == "gap"]


@pytest.mark.parametrize("topic", ["states", "commands"])
def test_messages_missing_in_one_topic_are_marked_as_a_gap(topic: str) -> None:
    read = recording(
        without(states(), 150, 250) if topic == "states" else states(),
        without(commands(), 150, 250) if topic == "commands" else commands(),
    )
    (made,) = make_trials(read, structure())
    assert [m.kind for m in made.marks] == ["gap"]


def test_a_gap_in_slow_commands_during_a_gap_in_states_cuts_the_recording() -> None:
    sent = commands()
    slow = replace(sent, stamp=sent.stamp[::10], log_time=sent.stamp[::10], position=SENT[::10])
    # 0.3 s of states at 100 Hz, three commands at 10 Hz.
    read = recording(without(states(), 151, 181), without(slow, 16, 19))
    assert len(make_trials(read, structure())) == 2


def test_rare_step_commands_do_not_cut_the_recording() -> None:
    sent = np.array([0, 7, 60, 200, 213, 300, 380])
    one = commands()
    rare = replace(one, stamp=one.stamp[sent], log_time=one.stamp[sent], position=SENT[sent])
    assert len(make_trials(recording(states(), rare), structure())) == 1


def test_a_recording_with_one_state_is_a_trial() -> None:
    read: Recording = recording(without(states(), 1, COUNT), commands())
    (made,) = make_trials(read, structure())
    assert len(made.time) == 1
