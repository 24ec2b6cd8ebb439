"""Motions that are not repeatable are predicted in windows, each from its measured state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from two_pendulums import ARMATURE, DAMPING, INERTIA, KP, KV, LENGTH, MASS, mjcf, record

from pytest_twin.diagnosis.diagnose import diagnose
from pytest_twin.diagnosis.effect_selection import EffectSelection
from pytest_twin.diagnosis.findings import Explanation
from pytest_twin.diagnosis.free_initial_state import count_free_states
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search_result import (
    SearchResult,
    confirm_effects,
    refit_whole_motions,
    search,
)
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.diagnosis.verdict import JointError
from pytest_twin.diagnosis.windows import WINDOW
from pytest_twin.estimation.hypothesis import EMPTY, Term
from pytest_twin.loaded_model import load_model
from pytest_twin.realization import Realization

LAG, SHORT_LAG = 0.05, 0.01
"""Lag of an unstable and of a stable servo, s."""
SECONDS = 1.8
"""Duration of a recording, s."""
ACTUATOR_LAG = Term("actuator_lag", 0)
ONE = ("left",)


def one_pendulum(
    folder: Path, seconds: float = SECONDS, **hidden: float
) -> tuple[Realization, TrialSet]:
    """One pendulum and three recordings with hidden effects."""
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


def test_the_servo_with_the_long_lag_is_unstable() -> None:
    """Routh: ``lag I s^3 + I s^2 + (kv + d) s + (kp - m g l)`` is unstable for a long lag."""
    inertia = INERTIA + MASS * LENGTH**2 + ARMATURE
    stiffness, damping = KP - MASS * 9.81 * LENGTH, KV + DAMPING
    assert inertia * damping < LAG * inertia * stiffness


def test_the_lag_of_an_unstable_servo_is_found_in_windows(tmp_path: Path) -> None:
    realization, trials = one_pendulum(tmp_path, lag=LAG)
    found = diagnose(realization, trials, threads=1)
    assert found.verdict == "explained"
    (finding,) = found.explanation.findings
    assert (finding.effect, finding.joint) == ("actuator_lag", "left")
    estimate = finding.parameters["time_constant"]
    assert estimate.value == pytest.approx(LAG, rel=0.05)
    assert estimate.low <= LAG <= estimate.high
    assert any("windows of 0.5 s" in note for note in found.notes)
    assert found.errors["left"].after < 3.0 * found.errors["left"].floor


def test_a_motion_that_is_explained_as_a_whole_is_not_cut_into_windows(tmp_path: Path) -> None:
    realization, trials = one_pendulum(tmp_path, seconds=1.2, delay=0.02)
    found = diagnose(realization, trials, threads=1)
    assert [f.effect for f in found.explanation.findings] == ["command_delay"]
    assert not any("windows" in note for note in found.notes)


@pytest.fixture(scope="module")
def stable_lag(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Realization, TrialSet, SearchResult]:
    """A stable servo with a lag, its recordings, and the result of a search in whole motions."""
    realization, trials = one_pendulum(tmp_path_factory.mktemp("stable_lag"), lag=SHORT_LAG)
    prepared = prepare(realization, trials.fit, trials.held_out, threads=1)
    found = search(prepared, trials, EffectSelection(prepared.problem))
    return realization, trials, found


def test_effects_found_in_windows_are_fitted_to_whole_motions(
    stable_lag: tuple[Realization, TrialSet, SearchResult],
) -> None:
    realization, trials, found = stable_lag
    cut = prepare(realization, trials.fit, trials.held_out, threads=1, window=WINDOW)
    other = search(cut, trials, EffectSelection(cut.problem))
    whole = refit_whole_motions(found, other)
    (finding,) = whole.explanation.findings
    assert (finding.effect, finding.confidence) == (
        "actuator_lag",
        other.selected.confidence[ACTUATOR_LAG],
    )
    assert finding.parameters["time_constant"].value == pytest.approx(SHORT_LAG, rel=0.02)
    assert whole.prepared is found.prepared
    assert whole.verdict == "explained"
    # A result at the noise floor needs no improvement by a fit to whole motions.
    assert whole.may_improve(replace(other, errors=with_larger_errors(other.errors, times=5.0)))
    assert not whole.may_improve(other)
    assert not whole.scores_better_than(whole)
    without_findings = replace(
        whole,
        explanation=Explanation((), EMPTY),
        errors=with_larger_errors(whole.errors, times=30.0),
    )
    assert whole.scores_better_than(without_findings)
    assert not without_findings.scores_better_than(whole)
    assert whole.tracks_better_than(without_findings)
    assert not whole.tracks_better_than(whole)
    assert not without_findings.tracks_better_than(whole)
    assert not whole.may_improve(without_findings)
    outdated = replace(
        whole, errors=with_larger_errors(whole.errors, times=30.0), verdict="improved"
    )
    updated = outdated.with_floor_of(whole)
    assert (updated.errors, updated.verdict) == (whole.errors, whole.verdict)


def test_effects_found_in_whole_motions_are_compared_with_alternatives_in_windows(
    stable_lag: tuple[Realization, TrialSet, SearchResult],
) -> None:
    realization, trials, whole = stable_lag
    cut = prepare(realization, trials.fit, trials.held_out, threads=1, window=WINDOW)
    found = confirm_effects(cut, trials, whole, Run())
    assert found is not None
    assert found.verdict == "explained"
    assert found.prepared is cut
    (finding,) = found.explanation.findings
    assert finding.effect == "actuator_lag"
    assert finding.confidence == found.selected.confidence[ACTUATOR_LAG]
    # A result without findings, or with effects that do not explain the windows, is not confirmed.
    for hypothesis in (EMPTY, EMPTY.with_term(Term("encoder_scale", 0), np.array([0.1]))):
        other = replace(whole, explanation=Explanation((), hypothesis))
        assert confirm_effects(cut, trials, other, Run()) is None


def with_larger_errors(errors: Mapping[str, JointError], times: float) -> dict[str, JointError]:
    """Errors that equal the present nominal error, with a nominal error ``times`` as large."""
    return {j: replace(e, after=e.before, before=times * e.before) for j, e in errors.items()}


def test_windows_start_at_the_measured_state_with_free_shifts(tmp_path: Path) -> None:
    realization, trials = one_pendulum(tmp_path)
    whole = prepare(realization, trials.fit, trials.held_out, threads=1).problem
    cut = prepare(realization, trials.fit, trials.held_out, threads=1, window=WINDOW).problem
    assert [s.starts_in_motion for s in whole.simulator.segments] == [False] * 3
    assert all(s.starts_in_motion for s in cut.simulator.segments)
    assert len(cut.simulator.segments) == pytest.approx(3 * SECONDS / WINDOW, abs=3)
    assert {count_free_states(s) for s in whole.simulator.segments} == {0}
    assert {count_free_states(s) for s in cut.simulator.segments} == {2}
    first = cut.simulator.segments[1]
    trial = trials.fit[0]
    read = np.interp(first.start, trial.time, trial.position[:, 0])
    assert first.initial_position == pytest.approx([read], abs=3e-4)
    velocity_servo = replace(whole.simulator.segments[0], mode="velocity")
    assert count_free_states(velocity_servo) == 1
