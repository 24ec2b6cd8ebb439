"""Setpoint between command stamps: held, interpolated or ramped."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from replay_trials import ARM, model, recording, series, slider

from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment
from pytest_twin.errors import RecordingError
from pytest_twin.open_loop import Row, replay_rows
from pytest_twin.recording_options import CommandBetween, RecordingOptions
from pytest_twin.trial import Trial, make_trial
from pytest_twin.trial.setpoint import setpoint

BETWEEN: tuple[CommandBetween, ...] = ("held", "interpolated", "ramped")
# Irregular stamps, s, that fall between the simulation steps.
STAMPS = 0.0213 * np.arange(60) + 0.004 * np.sin(np.arange(60) ** 2)


def trial_of(
    between: CommandBetween, command: np.ndarray, joints: tuple[str, ...], mode: str
) -> Trial:
    time = 0.002 * np.arange(500)
    made = make_trial(
        recording(
            series("/joint_states", joints, time, position=np.zeros((500, len(joints)))),
            series("/joint_commands", joints, STAMPS, **{mode: command}),
        ),
        options=RecordingOptions(command_between=between),
    )
    assert made.command_between == between
    return made


def integral(between: CommandBetween, command: np.ndarray, until: np.ndarray) -> np.ndarray:
    """Time integral of the setpoint by its definition, on a grid of 1 us."""
    time = STAMPS - STAMPS[0] + (STAMPS[0])
    fine = 1e-6 * np.arange(int(1e6 * until[-1]) + 2)
    k = np.maximum(np.searchsorted(time, fine + 1e-12, side="right") - 1, 0)
    if between == "held":
        value = command[k]
    elif between == "interpolated":
        value = np.interp(fine, time, command)
    else:
        period = float(np.median(np.diff(time)))
        value, now = np.empty(len(fine)), command[0]
        starts = np.searchsorted(fine, time)
        value[: starts[0]] = now
        for i, begin in enumerate(starts):
            end = starts[i + 1] if i + 1 < len(starts) else len(fine)
            part = np.clip((fine[begin:end] - time[i]) / period, 0.0, 1.0)
            value[begin:end] = now + (command[i] - now) * part
            reach = (time[i + 1] - time[i]) / period if i + 1 < len(time) else 1.0
            now = now + (command[i] - now) * min(reach, 1.0)
    summed = np.concatenate([[0.0], np.cumsum(0.5 * (value[1:] + value[:-1])) * 1e-6])
    return np.interp(until, fine, summed)


@pytest.mark.parametrize("between", BETWEEN)
def test_a_mass_gains_the_momentum_of_the_commanded_force(between: CommandBetween) -> None:
    """v(t) is the time integral of the force divided by the mass."""
    force = 3.0 * np.sin(7.0 * STAMPS) + np.sign(np.sin(3.0 * STAMPS))
    trial = trial_of(between, force, ("x",), "effort")
    stepped = model(slider('<motor joint="x"/>', mass=2.0, timestep=2e-3))
    (found,) = replay_rows([Row(trial, stepped)], threads=1)
    expected = integral(between, force, trial.time) / 2.0
    assert np.abs(found.velocity[:, 0] - expected).max() < 4e-6
    assert np.abs(expected).max() > 0.1


def test_held_interpolated_and_ramped_commands_give_different_motions() -> None:
    command = np.column_stack([0.5 * np.sin(6.0 * STAMPS), 0.3 * np.sin(5.0 * STAMPS)])
    arm = mujoco.MjModel.from_xml_string(ARM)
    trials = [trial_of(b, command, ("shoulder", "elbow"), "position") for b in BETWEEN]
    held, interpolated, ramped = (
        r.position for r in replay_rows([Row(t, arm) for t in trials], threads=1)
    )
    assert np.abs(held - interpolated).max() > 5e-3
    # A ramped command is the interpolated command about one period (21 ms) later.
    difference = np.abs(ramped - interpolated).max()
    assert np.abs(ramped[11:] - interpolated[:-11]).max() < 0.3 * difference


@pytest.mark.parametrize("between", BETWEEN)
def test_a_20_times_shorter_step_gives_the_same_motion(between: CommandBetween) -> None:
    command = np.column_stack([0.5 * np.sin(6.0 * STAMPS), 0.3 * np.sin(5.0 * STAMPS)])
    trial = trial_of(between, command, ("shoulder", "elbow"), "position")
    arms = [
        mujoco.MjModel.from_xml_string(
            ARM.replace(
                'timestep="0.002" integrator="implicitfast"', f'timestep="{step}" integrator="RK4"'
            ).replace('frictionloss="0.05" ', "")
        )
        for step in (1e-3, 5e-5)
    ]
    coarse, fine = replay_rows([Row(trial, arm) for arm in arms], threads=1)
    assert np.abs(coarse.position - fine.position).max() < 2e-5
    assert np.ptp(fine.position) > 0.2


@pytest.mark.parametrize("between", BETWEEN)
def test_the_batch_simulator_uses_the_same_setpoints_as_the_replay(between: CommandBetween) -> None:
    command = np.column_stack([0.5 * np.sin(6.0 * STAMPS), 0.3 * np.sin(5.0 * STAMPS)])
    trial = trial_of(between, command, ("shoulder", "elbow"), "position")
    arm = mujoco.MjModel.from_xml_string(ARM.replace('frictionloss="0.05" ', ""))
    setpoint_of_trial = trial.setpoint
    segment = Segment(
        trial=0, model=arm, mode="position", start=0.0, time=trial.time,
        position=trial.position, velocity=None, effort=None, command_time=setpoint_of_trial.time,
        command=setpoint_of_trial.value, initial_position=np.zeros(2), initial_velocity=np.zeros(2),
        is_interpolated=setpoint_of_trial.is_linear,
    )  # fmt: skip
    rows = BatchSimulator([segment], trial.joints, threads=1)
    found = rows.simulate(np.array([0]), {})[0]
    (replayed,) = replay_rows([Row(trial, arm)], threads=1)
    assert np.abs(found.position - replayed.position).max() < 1e-9
    # A delay of a whole number of steps only shifts the commands.
    late = replace(segment, command_time=setpoint_of_trial.time + 0.02)
    (delayed,) = BatchSimulator([late], trial.joints, threads=1).simulate(np.array([0]), {})
    by_effect = rows.simulate(np.array([0]), {"command_delay": {"delay": np.full((1, 2), 0.02)}})
    assert np.abs(by_effect[0].position - delayed.position).max() < 1e-9


def test_interpolation_runs_between_messages_that_contain_the_joint() -> None:
    time = np.array([0.0, 1.0, 2.0, 3.0])
    command = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 4.0], [6.0, 4.0]])
    own = np.array([[True, True], [True, False], [False, True], [True, False]])
    found = setpoint(time, command, "interpolated", own).at(np.array([0.5, 1.5, 2.5, 9.0]))
    assert found == pytest.approx(np.array([[1.0, 1.0], [3.0, 3.0], [5.0, 4.0], [6.0, 4.0]]))


def test_a_ramp_starts_at_the_stamp_and_ends_one_period_later() -> None:
    time = np.array([0.0, 1.0, 2.0, 5.0, 6.0])
    command = np.array([[0.0], [1.0], [3.0], [4.0], [4.0]])
    found = setpoint(time, command, "ramped").at(np.array([0.9, 1.5, 2.0, 2.5, 3.0, 4.9, 5.5, 7.0]))
    assert found[:, 0] == pytest.approx([0.0, 0.5, 1.0, 2.0, 3.0, 3.0, 3.5, 4.0])


def test_an_interrupted_ramp_continues_from_its_current_value() -> None:
    time = np.array([0.0, 1.0, 2.0, 2.5, 4.0])
    command = np.array([[0.0], [0.0], [2.0], [0.0], [0.0]])
    found = setpoint(time, command, "ramped").at(np.array([2.5, 3.0, 3.5]))
    assert found[:, 0] == pytest.approx([1.0, 0.5, 0.0])


# -- which source decides


def mode_and_source(metadata: str | None, **options: CommandBetween) -> tuple[str, str]:
    time = 0.01 * np.arange(50)
    made = make_trial(
        recording(
            series("/joint_states", ("x",), time, position=time),
            series("/joint_commands", ("x",), time, position=time),
            {} if metadata is None else {"command_between": metadata},
        ),
        options=RecordingOptions(**options),
    )
    return made.command_between, made.between_source


def test_the_option_overrides_the_metadata_and_the_metadata_overrides_the_twin() -> None:
    assert mode_and_source(None) == ("held", "assumed")
    assert mode_and_source(None, command_between_default="ramped") == ("ramped", "twin.yaml")
    assert mode_and_source("interpolated", command_between_default="ramped") == (
        "interpolated",
        "metadata",
    )
    assert mode_and_source("interpolated", command_between="held") == ("held", "option")


def test_an_unknown_value_of_command_between_is_refused() -> None:
    with pytest.raises(RecordingError) as refusal:
        mode_and_source("smooth")
    assert str(refusal.value) == (
        "made.mcap: metadata 'trial': command_between of the trial's metadata is unknown "
        "(got 'smooth'; expected held or interpolated or ramped)"
    )
