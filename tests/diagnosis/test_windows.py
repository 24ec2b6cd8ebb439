"""Motions that do not do the same twice are predicted in windows that start from what was read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from two_pendulums import ARMATURE, DAMPING, INERTIA, KP, KV, LENGTH, MASS, mjcf, record

from pytest_twin.commands.replay import load_model
from pytest_twin.diagnosis.diagnose import diagnose
from pytest_twin.diagnosis.findings import Explained
from pytest_twin.diagnosis.free_initial_state import free_shifts
from pytest_twin.diagnosis.hypothesis import EMPTY, Term
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search.stepwise_selection import StepwiseSelection
from pytest_twin.diagnosis.search_result import SearchResult, confirm, refit_whole_motions, search
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.diagnosis.verdict import JointError
from pytest_twin.diagnosis.windows import WINDOW
from pytest_twin.realization import Realization

LAG, SHORT_LAG = 0.05, 0.01
"""s, of a servo that is unstable and of one that is stable."""
LAGS = Term("actuator_lag", 0)
ONE = ("left",)


def hunting(folder: Path, seconds: float = 4.0, **hidden: float) -> tuple[Realization, TrialSet]:
    """A pendulum whose servo lags, and three recordings."""
    model = folder / "model.xml"
    model.write_text(mjcf(ONE))
    files = [
        record(
            folder / f"{role}{seed}.mcap", seed, role=role, seconds=seconds, joints=ONE, **hidden
        )
        for seed, role in ((1, "fit"), (2, "fit"), (3, "held_out"))
    ]
    loaded = load_model(model)
    return loaded.realization, read_trials(files, [], loaded.topics, loaded.realization.structure)


def test_the_servo_of_this_test_hunts() -> None:
    """Routh: ``lag I s^3 + I s^2 + (kv + d) s + (kp - m g l)`` is unstable for a long lag."""
    inertia = INERTIA + MASS * LENGTH**2 + ARMATURE
    stiffness, damping = KP - MASS * 9.81 * LENGTH, KV + DAMPING
    assert inertia * damping < LAG * inertia * stiffness


def test_a_lag_that_makes_a_servo_hunt_is_named_with_its_time(tmp_path: Path) -> None:
    realization, trials = hunting(tmp_path, lag=LAG)
    found = diagnose(realization, trials, threads=1)
    assert found.verdict == "explained"
    (finding,) = found.explained.findings
    assert (finding.effect, finding.joint) == ("actuator_lag", "left")
    estimate = finding.parameters["time_constant"]
    assert estimate.value == pytest.approx(LAG, rel=0.05)
    assert estimate.low <= LAG <= estimate.high
    assert any("windows of 0.5 s" in note for note in found.notes)
    assert found.errors["left"].after < 3.0 * found.errors["left"].floor


def test_a_motion_that_is_followed_whole_stays_whole(tmp_path: Path) -> None:
    realization, trials = hunting(tmp_path, seconds=2.2, delay=0.02)
    found = diagnose(realization, trials, threads=1)
    assert [f.effect for f in found.explained.findings] == ["command_delay"]
    assert not any("windows" in note for note in found.notes)


@pytest.fixture(scope="module")
def lagging(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Realization, TrialSet, SearchResult]:
    """A servo that lags and is stable, its recordings, and a search over whole motions."""
    realization, trials = hunting(tmp_path_factory.mktemp("lagging"), lag=SHORT_LAG)
    prepared = prepare(realization, trials.fit, trials.held_out, threads=1)
    found = search(prepared, trials, StepwiseSelection(prepared.problem))
    return realization, trials, found


def test_what_windows_name_is_fitted_over_whole_motions(
    lagging: tuple[Realization, TrialSet, SearchResult],
) -> None:
    realization, trials, found = lagging
    cut = prepare(realization, trials.fit, trials.held_out, threads=1, window=WINDOW)
    other = search(cut, trials, StepwiseSelection(cut.problem))
    whole = refit_whole_motions(found, other)
    (finding,) = whole.explained.findings
    assert (finding.effect, finding.confidence) == ("actuator_lag", other.selected.confidence[LAGS])
    assert finding.parameters["time_constant"].value == pytest.approx(SHORT_LAG, rel=0.02)
    assert whole.prepared is found.prepared
    assert whole.verdict == "explained"
    # Both name what explains most; what leaves next to nothing has nothing to gain.
    assert whole.may_improve(replace(other, errors=off(other.errors, times=5.0)))
    assert not whole.may_improve(other)
    assert not whole.scores_better_than(whole)
    nothing = replace(whole, explained=Explained((), EMPTY), errors=off(whole.errors, times=30.0))
    assert whole.scores_better_than(nothing)
    assert not nothing.scores_better_than(whole)
    assert whole.tracks_better_than(nothing)
    assert not whole.tracks_better_than(whole)
    assert not nothing.tracks_better_than(whole)
    assert not whole.may_improve(nothing)
    once = replace(whole, errors=off(whole.errors, times=30.0), verdict="improved")
    again = once.with_floor_of()
    assert (again.errors, again.verdict) == (whole.errors, whole.verdict)


def test_what_whole_motions_name_is_held_against_its_rivals_in_windows(
    lagging: tuple[Realization, TrialSet, SearchResult],
) -> None:
    realization, trials, whole = lagging
    cut = prepare(realization, trials.fit, trials.held_out, threads=1, window=WINDOW)
    found = confirm(cut, trials, whole, Run())
    assert found is not None
    assert found.verdict == "explained"
    assert found.prepared is cut
    (finding,) = found.explained.findings
    assert finding.effect == "actuator_lag"
    assert finding.confidence == found.selected.confidence[LAGS]
    # What does not explain the windows, or names nothing, leaves them to a search of their own.
    for hypothesis in (EMPTY, EMPTY.with_term(Term("encoder_scale", 0), np.array([0.1]))):
        other = replace(whole, explained=Explained((), hypothesis))
        assert confirm(cut, trials, other, Run()) is None


def off(errors: Mapping[str, JointError], times: float) -> dict[str, JointError]:
    """As much more is left."""
    return {j: replace(e, after=e.before, before=times * e.before) for j, e in errors.items()}


def test_windows_start_from_what_was_measured_and_are_free_to_shift(tmp_path: Path) -> None:
    realization, trials = hunting(tmp_path)
    whole = prepare(realization, trials.fit, trials.held_out, threads=1).problem
    cut = prepare(realization, trials.fit, trials.held_out, threads=1, window=WINDOW).problem
    assert [s.starts_in_motion for s in whole.simulator.segments] == [False] * 3
    assert all(s.starts_in_motion for s in cut.simulator.segments)
    assert len(cut.simulator.segments) == pytest.approx(3 * 4.0 / WINDOW, abs=3)
    assert {free_shifts(s) for s in whole.simulator.segments} == {0}
    assert {free_shifts(s) for s in cut.simulator.segments} == {2}
    first = cut.simulator.segments[1]
    trial = trials.fit[0]
    read = np.interp(first.start, trial.time, trial.position[:, 0])
    assert first.initial_position == pytest.approx([read], abs=3e-4)
    velocity_servo = replace(whole.simulator.segments[0], mode="velocity")
    assert free_shifts(velocity_servo) == 1
