"""Motions that are not repeatable are predicted in windows, each from its measured state."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from two_pendulums import ARMATURE, DAMPING, INERTIA, KP, KV, LENGTH, MASS, mjcf, record

from pytest_twin.diagnosis.diagnose import diagnose
from pytest_twin.diagnosis.free_initial_state import count_free_states
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.diagnosis.windows import WINDOW
from pytest_twin.loaded_model import load_model
from pytest_twin.realization import Realization

LAG = 0.05
"""Lag of an unstable servo, s."""
SECONDS = 1.8
"""Duration of a recording, s."""
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
