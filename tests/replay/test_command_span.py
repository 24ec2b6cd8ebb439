"""Recordings whose commands begin late, end early, change their field, or miss a joint."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from replay_trials import ARM, recording, series

from pytest_twin import cli
from pytest_twin.diagnosis.windows import Cutting, segments_of
from pytest_twin.formats.mcap import write_recording
from pytest_twin.realization import load
from pytest_twin.trial import make_trials

pytestmark = pytest.mark.usefixtures("commands_in_process")
JOINTS = ("shoulder", "elbow")
NOISE = 2e-4
"""rad. Standard deviation of the recorded positions."""
TIME = np.arange(0.0, 6.0, 0.01)


@pytest.fixture(scope="module")
def motion() -> tuple[np.ndarray, np.ndarray]:
    """Positions and commands of the arm, which never rests."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    command = np.column_stack([0.5 * np.sin(1.5 * TIME), 0.4 * np.sin(2.3 * TIME)])
    position = []
    for setpoint in command:
        data.ctrl[:] = setpoint
        position.append(data.qpos + NOISE * rng.standard_normal(2))
        mujoco.mj_step(model, data, 5)
    return np.array(position), command


def replay(
    folder: Path, measured: np.ndarray, rows: slice = slice(None), **fields: np.ndarray
) -> dict:
    (folder / "arm.xml").write_text(ARM)
    state = series("/joint_states", JOINTS, TIME, position=measured)
    given = {name: table[rows] for name, table in fields.items()}
    sent = series("/joint_commands", JOINTS, TIME[rows], **given)
    write_recording(folder / "log.mcap", [state, sent])
    out = folder / "out.mcap"
    words = [str(folder / "arm.xml"), str(folder / "log.mcap"), "--out", str(out)]
    assert cli.main(["replay", *words]) == 0
    return json.loads(out.with_suffix(".json").read_text())


def worst(summary: dict) -> float:
    return max(joint["rms"] for joint in summary["joints"].values())


def test_a_moving_joint_is_predicted_from_its_first_command_on(
    tmp_path: Path, motion: tuple[np.ndarray, np.ndarray]
) -> None:
    position, command = motion
    summary = replay(tmp_path, position, slice(200, None), position=command)
    assert summary["parts"] == [{"start": pytest.approx(2.0), "end": pytest.approx(5.99)}]
    # The state has no velocity: the robot starts from rest.
    assert worst(summary) < 1e-3
    assert summary["notes"][0].startswith("used from 2 to 5.99 s: 'shoulder' moves by 0.51")


def test_a_joint_that_rests_before_its_first_command_is_held_by_it(
    tmp_path: Path, motion: tuple[np.ndarray, np.ndarray]
) -> None:
    position, command = motion
    at_rest = np.vstack([np.tile(position[0], (200, 1)), position[:-200]])
    later = np.vstack([np.tile(command[0], (200, 1)), command[:-200]])
    summary = replay(tmp_path, at_rest, slice(200, None), position=later)
    assert summary["duration"]["value"] == pytest.approx(5.99)
    assert not any("used from" in note for note in summary["notes"])


def test_a_joint_that_moves_on_after_its_commands_is_predicted_to_the_last_one(
    tmp_path: Path, motion: tuple[np.ndarray, np.ndarray]
) -> None:
    position, command = motion
    summary = replay(tmp_path, position, slice(0, 400), position=command)
    assert summary["duration"]["value"] == pytest.approx(3.99)
    assert worst(summary) < 1.2 * NOISE
    assert "still moves by" in summary["notes"][0]


def test_a_joint_without_commands_for_a_while_is_left_out_of_that_time(
    tmp_path: Path, motion: tuple[np.ndarray, np.ndarray]
) -> None:
    position, command = motion
    late = command.copy()
    late[:300, 1] = np.nan
    summary = replay(tmp_path, position, position=late)
    assert summary["parts"][0]["start"] == pytest.approx(3.0)
    assert "'elbow' moves by" in summary["notes"][0]


@pytest.mark.parametrize("empty", [np.nan, 0.0])
@pytest.mark.parametrize("other", ["velocity", "effort"])
def test_a_change_of_the_controller_ends_the_part_that_is_used(
    tmp_path: Path, motion: tuple[np.ndarray, np.ndarray], empty: float, other: str
) -> None:
    position, command = motion
    used = command.copy()
    used[300:] = empty
    rest = np.gradient(command, 0.01, axis=0)
    rest[:300] = empty
    summary = replay(tmp_path, position, position=used, **{other: rest})
    assert summary["duration"]["value"] == pytest.approx(2.99)
    assert worst(summary) < 1.2 * NOISE
    assert f"change from position to {other} at 3 s" in summary["notes"][0]


def test_a_change_of_the_controller_and_back_leaves_two_parts(
    tmp_path: Path, motion: tuple[np.ndarray, np.ndarray]
) -> None:
    position, command = motion
    used, rest = command.copy(), np.full_like(command, np.nan)
    used[200:300] = np.nan
    rest[200:300] = 0.1
    summary = replay(tmp_path, position, position=used, effort=rest)
    ends = [(round(part["start"], 2), round(part["end"], 2)) for part in summary["parts"]]
    assert ends == [(0.0, 1.99), (3.0, 5.99)]
    assert worst(summary) < 1e-3


def test_a_position_with_feedforward_is_no_change_of_the_controller(
    tmp_path: Path, motion: tuple[np.ndarray, np.ndarray]
) -> None:
    position, command = motion
    summary = replay(tmp_path, position, position=command, effort=0.1 * command)
    assert summary["duration"]["value"] == pytest.approx(5.99)


def test_a_joint_that_moves_without_a_command_is_said(
    tmp_path: Path, motion: tuple[np.ndarray, np.ndarray]
) -> None:
    position, command = motion
    only = command.copy()
    only[:, 1] = np.nan
    summary = replay(tmp_path, position, position=only)
    said = [note for note in summary["notes"] if "without a command" in note]
    assert "although the recording shows motion: elbow (by 0.79" in said[0]


@pytest.mark.parametrize("command", ["replay", "diagnose"])
def test_commands_that_no_actuator_takes_are_refused_with_the_recording(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    moves = np.sin(TIME)[:, None] * [0.3, 0.4]
    state = series("/joint_states", JOINTS, TIME, position=moves)
    sent = series("/joint_commands", JOINTS, TIME, effort=moves + 1.0)
    write_recording(tmp_path / "log.mcap", [state, sent])
    words = [str(tmp_path / "arm.xml"), str(tmp_path / "log.mcap"), "--out"]
    assert cli.main([command, *words, str(tmp_path / "out.mcap")]) == 2
    error = capsys.readouterr().err
    assert "log.mcap: no actuator of joint 'shoulder' takes effort commands" in error
    assert "its actuator takes position'; expected a model with a motor there, or" in error


def test_a_joint_that_rests_away_from_its_late_first_command_is_replayed_from_it() -> None:
    """Held from the begin on, the first command would move the model before the robot moved."""
    time = np.arange(300) * 0.01
    command_time = 1.0 + np.arange(200) * 0.01
    position = np.where(time < 1.0, 0.0, 0.5 * (1.0 - np.exp(-8.0 * (time - 1.0))))
    parts = make_trials(
        recording(
            series("/joint_states", ("x",), time, position=position),
            series("/joint_commands", ("x",), command_time, position=np.full(200, 0.5)),
        )
    )
    (part,) = parts
    assert part.offset == pytest.approx(1.0)
    assert "'x' rests 0.5 rad or m away from its first command, at 1 s" in " ".join(part.notes)
    held = make_trials(
        recording(
            series("/joint_states", ("x",), time, position=position + 0.499),
            series("/joint_commands", ("x",), command_time, position=np.full(200, 0.5)),
        )
    )
    assert held[0].offset == 0.0


@pytest.mark.parametrize("field", ["velocity", "effort"])
def test_a_late_first_velocity_or_effort_does_not_act_before_it_was_sent(field: str) -> None:
    """A joint may rest before it, with its brake on; the value would move it from the start."""
    time, sent = np.arange(300) * 0.01, 1.0 + np.arange(200) * 0.01
    position = 0.2 * np.clip(time - 1.0, 0.0, None) ** 2
    states = series("/joint_states", ("x",), time, position=position)
    commands = series("/joint_commands", ("x",), sent, **{field: np.full(200, 0.4)})
    (part,) = make_trials(recording(states, commands))
    assert part.offset == pytest.approx(1.0)
    assert f"the first {field} command of 'x' is at 1 s" in " ".join(part.notes)
    in_time = series("/joint_commands", ("x",), sent - 0.97, **{field: np.full(200, 0.4)})
    assert make_trials(recording(states, in_time))[0].offset == 0.0


@pytest.mark.parametrize("seconds", [0.4, 3.0])
def test_a_diagnosis_simulates_the_time_that_a_replay_simulates(
    tmp_path: Path, seconds: float
) -> None:
    """Both begin where the trial does, also if little remains after a late first command."""
    (tmp_path / "arm.xml").write_text(
        '<mujoco><worldbody><body><joint name="x" axis="0 1 0"/><geom size=".1" mass="1"/></body>'
        '</worldbody><actuator><position joint="x" kp="9"/></actuator></mujoco>'
    )
    time = np.arange(round((1.0 + seconds) / 0.01)) * 0.01
    sent = time[time >= 1.0]
    for position, offset in ((0.3 + 0.0 * time, 0.0), (0.3 * np.sin(3.0 * time), 1.0)):
        states = series("/joint_states", ("x",), time, position=position)
        commands = series("/joint_commands", ("x",), sent, position=np.full(len(sent), 0.3))
        (trial,) = make_trials(recording(states, commands))
        assert trial.offset == offset
        robot = load(tmp_path / "arm.xml")
        segment = segments_of(robot, trial, 0, ("x",), Cutting(skips_hole=True))[-1]
        assert segment.time[-1] == trial.time[-1]
        if not offset:
            assert segment.start == segment.time[0] == 0.0
