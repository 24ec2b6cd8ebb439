"""Times of command steps between two stamps, where the setpoint moves on between them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded_pendulum import Reality, cell

from pytest_twin.diagnosis.build_problem import build_problem
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.signal_meaning import determine_signals
from pytest_twin.diagnosis.signal_meaning.recorded_signals import RecordedSignals
from pytest_twin.diagnosis.signal_meaning.step_times import (
    fit_step_shares,
    step_intervals,
    with_steps_at,
)
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.estimation.hypothesis import EMPTY
from pytest_twin.loaded_model import find_model, load_model
from pytest_twin.trial import Trial

STEPPING = Reality("interpolated", command_period=0.01, stepping=True)
# Steps of the pendulum's setpoint begin 1 ms after a stamp, a tenth of the period.
SHARE = 0.1


def read(folder: Path, reality: Reality, *, seconds: float = 2.5) -> tuple[ModelSetup, TrialSet]:
    model, recordings = cell(folder / "cell", reality, (2, 4, 5, 7), seconds)
    loaded = load_model(find_model(model))
    trials = read_trials(recordings, [], loaded.topics, loaded.realization.structure)
    return ModelSetup.of(loaded.realization, None, 1), trials


def settled(setup: ModelSetup, trials: TrialSet) -> RecordedSignals:
    return determine_signals(setup, replace(trials, held_out=()))


def rms(setup: ModelSetup, trial: Trial) -> float:
    prepared, _ = build_problem(setup, TrialSet((trial,), (), ()), [])
    problem = prepared.problem
    return float(np.sqrt(np.mean(problem.residuals([EMPTY], problem.fit)[0] ** 2)))


@pytest.mark.parametrize("seed", range(3))
def test_each_time_is_the_weighted_least_squares_estimate(seed: int) -> None:
    rng = np.random.default_rng(seed)
    time, starts = np.arange(0.0, 3.0, 0.004), np.array([0.5, 1.1, 2.2])
    shares = rng.uniform(0.05, 0.95, 3)
    since = time[:, None] - starts
    # A step that acts a period later moves each joint along its own response.
    response = np.where(since > 0.0, np.exp(-np.maximum(since, 0.0) / 0.05), 0.0)
    sizes = np.array([0.05, 0.002])
    change = response.sum(axis=1)[:, None] * sizes
    early = -(response @ shares)[:, None] * sizes + 1e-6 * rng.standard_normal((len(time), 2))
    found = fit_step_shares(early, early + change, time, starts)
    np.testing.assert_allclose(found, shares, atol=2e-3)


def test_a_step_that_the_motion_does_not_show_stays_in_the_middle() -> None:
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 1.0, 0.004)
    noise = 1e-3 * rng.standard_normal((len(time), 1))
    change = 1e-6 * np.where(time > 0.5, np.exp(-(time - 0.5) / 0.05), 0.0)[:, None]
    assert fit_step_shares(noise, noise + change, time, np.array([0.5])) == pytest.approx(
        0.5, abs=0.05
    )


def test_the_setpoint_steps_at_its_time_and_other_joints_move_on(tmp_path: Path) -> None:
    _, trials = read(tmp_path, STEPPING)
    trial = replace(
        trials.fit[0], command_joints=("a", "b"), command_modes=("position", "position"),
        command_time=np.arange(5) * 0.1, command_between="interpolated", own_commands=None,
        command=np.array([[0.0, 0.0], [0.0, 0.1], [1.0, 0.2], [1.0, 0.3], [1.0, 0.4]]),
    )  # fmt: skip
    assert step_intervals(trial.command).tolist() == [1]
    setpoint = with_steps_at(trial, np.array([0.3])).setpoint
    at = setpoint.at(np.array([0.05, 0.129, 0.131, 0.15, 0.25]))
    np.testing.assert_allclose(at[:, 0], [0.0, 0.0, 1.0, 1.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(at[:, 1], [0.05, 0.129, 0.131, 0.15, 0.25], atol=1e-6)


def test_the_times_of_steps_are_found_with_the_interpolation(tmp_path: Path) -> None:
    setup, trials = read(tmp_path, STEPPING)
    found = settled(setup, trials)
    (times,) = found.steps
    used = found.apply(trials)
    shares = [times.shares(t) for t in (*trials.fit, *trials.held_out)]
    assert [s is not None for s in shares] == [False, False, True, True]
    known = np.concatenate([s for s in shares if s is not None])
    np.testing.assert_allclose(known, SHARE, atol=0.08)
    assert any("commands step between two stamps" in n for n in used.notes)
    line = replace(trials.fit[2], command_between="interpolated")
    assert rms(setup, used.fit[2]) < 0.3 * rms(setup, line)


def test_held_commands_step_at_their_stamps(tmp_path: Path) -> None:
    setup, trials = read(tmp_path, replace(STEPPING, between="held", command_period=0.04))
    found = settled(setup, trials)
    assert found.steps == ()
    assert len(found.apply(trials).fit[2].command) == len(trials.fit[2].command)


def test_a_delay_of_the_drive_is_not_taken_for_late_steps(tmp_path: Path) -> None:
    setup, trials = read(tmp_path, replace(STEPPING, delay=0.006))
    declared = tuple(
        replace(t, command_between="interpolated", between_source="metadata") for t in trials.fit
    )
    found = settled(setup, replace(trials, fit=declared, held_out=()))
    assert found.between == ()
    (times,) = found.steps
    assert times.shares(declared[2]) == pytest.approx(SHARE, abs=0.08)
