"""Windows are shortened if the nominal model departs from the recordings within them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from two_pendulums import ARMATURE, DAMPING, INERTIA, LENGTH, MASS, STEP, reference, write

from pytest_twin.diagnosis import search_recordings
from pytest_twin.diagnosis.build_problem import build_problem, residuals_everywhere
from pytest_twin.diagnosis.diagnose import diagnose
from pytest_twin.diagnosis.findings import Explanation
from pytest_twin.diagnosis.longest_windows import errors_over_longest_windows
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.search.model import Model
from pytest_twin.diagnosis.search.report_rules import Rejections
from pytest_twin.diagnosis.search_result import SearchResult, joint_errors
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.diagnosis.window_length import model_follows_recordings, window_of_errors
from pytest_twin.estimation.hypothesis import EMPTY
from pytest_twin.loaded_model import load_model
from pytest_twin.realization import Realization

GRAVITY, NOISE = 9.81, 1e-4
MODEL = f"""
<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body>
    <inertial pos="0 0 {LENGTH}" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} 5e-4"/>
    <joint name="arm" axis="0 1 0" damping="{DAMPING}" armature="{ARMATURE}"/>
  </body></worldbody>
  <actuator><motor name="arm" joint="arm"/></actuator>
</mujoco>"""


def record_inverted_pendulum(folder: Path, seed: int, role: str, load: float) -> Path:
    """Record an inverted pendulum that an outer control loop balances with effort commands.

    A payload of ``load`` kg is at its center of mass.
    """
    setpoints = reference(seed, 1.8, 1)[:, 0]
    mass = MASS + load
    inertia = INERTIA + mass * LENGTH**2 + ARMATURE
    q = v = effort = 0.0
    moved, sent = np.empty(len(setpoints)), []
    for k, w in enumerate(setpoints):
        moved[k] = q
        if k % 100 == 0:
            effort = 6.0 * (w - q) - 0.6 * v
            sent.append(effort)
        v += STEP * (effort + mass * GRAVITY * LENGTH * np.sin(q) - DAMPING * v) / inertia
        q += STEP * v
    seen = np.arange(0, len(setpoints), 50)
    noise = NOISE * np.random.default_rng([seed, 1]).standard_normal(len(seen))
    path = folder / f"{role}{seed}.mcap"
    write(
        path, ("arm",), STEP * np.arange(0, len(setpoints), 100), np.array(sent)[:, None],
        STEP * seen, (moved[seen] + noise)[:, None], role, mode="effort",
    )  # fmt: skip
    return path


def case_of(folder: Path, load: float) -> tuple[Realization, TrialSet]:
    """The model, and recordings with a payload of ``load`` kg."""
    model = folder / "model.xml"
    model.write_text(MODEL)
    loaded = load_model(model)
    files = [
        record_inverted_pendulum(folder, s, r, load)
        for s, r in ((1, "fit"), (2, "fit"), (3, "held_out"))
    ]
    return loaded.realization, read_trials(files, [], loaded.topics, loaded.realization.structure)


@pytest.fixture(scope="module")
def light(tmp_path_factory: pytest.TempPathFactory) -> tuple[ModelSetup, SearchResult]:
    """A payload with which the model still follows the recordings, and no effect."""
    realization, trials = case_of(tmp_path_factory.mktemp("light"), load=0.02)
    setup = ModelSetup.of(realization, None, 1)
    prepared, trials = build_problem(setup, trials, [])
    left = residuals_everywhere(prepared.problem, EMPTY)
    errors = joint_errors(prepared, left, left)
    nothing = Explanation((), EMPTY)
    return setup, SearchResult(prepared, trials, 0, nothing, left, left, errors, "unexplained")


def test_a_payload_that_makes_the_arm_diverge_is_found(tmp_path: Path) -> None:
    found = diagnose(*case_of(tmp_path, load=1.2), threads=1)
    assert found.verdict == "explained"
    assert {t.law.family for t in found.explanation.hypothesis.terms} == {"rigid_body"}


def test_a_model_follows_recordings_up_to_a_quarter_of_the_travel(
    light: tuple[ModelSetup, SearchResult],
) -> None:
    problem = light[1].prepared.problem
    travel = np.array([np.ptp(s.position) for s in problem.simulator.segments])
    level = np.sqrt(np.mean(travel**2))
    left = np.ones_like(light[1].before)
    assert model_follows_recordings(problem, 0.24 * level * left)
    assert not model_follows_recordings(problem, 0.26 * level * left)


def test_an_error_that_short_windows_hide_is_measured_in_the_longest_that_the_model_follows(
    light: tuple[ModelSetup, SearchResult],
) -> None:
    """An inverted pendulum falls faster and faster away from a model with another payload."""
    setup, found = light
    short = window_of_errors(found.prepared.problem)
    assert short is not None
    longest = errors_over_longest_windows(found, setup)
    assert longest is not None
    assert longest.seconds >= 2.0 * short
    (before,), (after,) = found.errors.values(), longest.errors.values()
    assert after.after / after.floor > 2.0 * before.after / before.floor


@pytest.mark.parametrize(("load", "verdict"), [(0.0, "no_mismatch"), (0.01, "explained")])
def test_what_only_long_windows_show_is_sought_in_them(
    tmp_path: Path, load: float, verdict: str
) -> None:
    """In windows of 0.5 s a payload of 10 g changes the motion by less than three noise floors."""
    found = diagnose(*case_of(tmp_path, load), threads=1)
    assert found.verdict == verdict
    assert {t.law.family for t in found.explanation.hypothesis.terms} == (
        {"rigid_body"} if load else set()
    )


def test_an_effect_whose_interval_contains_its_absence_stays_if_its_removal_predicts_worse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The interval of a fit that a limit ended may be far too wide."""

    def all_absent(model: Model, *rest: object) -> Rejections:
        return Rejections({}, dict.fromkeys(model.hypothesis.terms, "it may be absent"))

    monkeypatch.setattr(search_recordings, "rejections", all_absent)
    found = diagnose(*case_of(tmp_path, load=0.1), threads=1).explanation
    assert {t.law.family for t in found.hypothesis.terms} == {"rigid_body"}
    assert all("without it the recordings are predicted worse" in f.small for f in found.findings)
