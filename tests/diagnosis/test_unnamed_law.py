"""Fit of forces without a name: functions of the state are found, other forces are refused."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from one_joint_plant import JOINT, STEP, Hidden, record

from pytest_twin.diagnosis.build_problem import build_problem, residuals_everywhere
from pytest_twin.diagnosis.findings import Explanation
from pytest_twin.diagnosis.first_order.sensitivities import Linearization
from pytest_twin.diagnosis.locate import TimeAndRegime
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.patched.model import AppliedEffect, PatchedModel, read_effects
from pytest_twin.diagnosis.patched.ranges import describe_range_exits
from pytest_twin.diagnosis.patched.replay import replay_patched
from pytest_twin.diagnosis.patched.write import write_realization
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.search_result import SearchResult, joint_errors
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.diagnosis.unnamed_law import table_fit
from pytest_twin.diagnosis.unnamed_law.confirmation import confirm_on_test, fit_laws_to_residual
from pytest_twin.diagnosis.unnamed_law.fit import FreeLaws, fit_free_laws
from pytest_twin.diagnosis.unnamed_law.settings import FREE_LAWS
from pytest_twin.effects.segment import Predicted
from pytest_twin.effects.unnamed_law import KNOTS, POSITION, UnnamedLaw
from pytest_twin.estimation.hypothesis import EMPTY
from pytest_twin.formats.schema import load_schema
from pytest_twin.realization import load
from pytest_twin.report.finding_words import finding_sentence
from pytest_twin.report.law_plot import law_figure

TOPICS = {"state": "/joint_states", "command": "/joint_commands"}
AT = 0.25
"""Position in rad of the forces that act at one place."""


def magnet(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A pull towards ``AT``."""
    x = (q - AT) / 0.06
    return -0.5 * x * np.exp(0.5 - x * x / 2.0)


def sticky(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Friction in a range of positions around ``AT``."""
    return -0.6 * np.tanh(v / 0.01) * np.exp(-(((q - AT) / 0.1) ** 2))


def rubber(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A spring with hysteresis that acts above ``AT``."""
    return -(2.0 + np.tanh(v / 0.01)) * np.maximum(q - AT, 0.0)


def notch(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A resistance in a range of speeds."""
    return -0.5 * np.sign(v) * np.exp(-(((np.abs(v) - 1.2) / 0.25) ** 2))


def push(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The same force pulse in every recording, at the same time."""
    return np.full_like(q, 0.6 * np.sin(np.pi * (t - 3.0) / 1.5) if 3.0 < t < 4.5 else 0.0)


def push_in_one(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A force pulse in one recording only."""
    out = push(t, q, v)
    out[1:] = 0.0
    return out


def random_torque(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A random torque with a correlation time of 0.2 s, different in each recording."""
    return RANDOM_TORQUES[min(int(t / STEP), len(RANDOM_TORQUES) - 1), : len(q)]


def _random_torques(steps: int, recordings: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    out, keep = np.zeros((steps, recordings)), np.exp(-STEP / 0.2)
    for k in range(1, steps):
        noise = rng.standard_normal(recordings)
        out[k] = keep * out[k - 1] + 0.4 * np.sqrt(1.0 - keep**2) * noise
    return out


RANDOM_TORQUES = _random_torques(round(10.0 / STEP), 5)


def prepared_case(
    folder: Path, hidden: Hidden, window: float | None
) -> tuple[PreparedProblem, TrialSet]:
    paths = sorted(folder.glob("*.mcap")) or record(folder, hidden)
    realization = load(folder / "model.xml")
    trials = read_trials(paths, [], TOPICS, realization.structure)
    return build_problem(ModelSetup.of(realization, None, 1), trials, [], window=window)


def fitted_laws(folder: Path, hidden: Hidden) -> FreeLaws:
    """Laws fitted to the fit recordings, without a preceding search."""
    near, _ = prepared_case(folder, hidden, 0.5)
    with np.errstate(over="ignore", invalid="ignore"):
        return fit_free_laws(near, EMPTY, {JOINT: TimeAndRegime("", {})}, near.problem.fit)


def removed(folder: Path, hidden: Hidden, laws: FreeLaws) -> float:
    """Share of the squared error of the held-out recordings that the laws remove."""
    problem = prepared_case(folder, hidden, None)[0].problem
    before, after = problem.errors([EMPTY, laws.hypothesis], problem.held_out)
    return 1.0 - float(np.sum(after**2) / np.sum(before**2))


@pytest.mark.parametrize(
    ("hidden", "accepted"),
    [
        (magnet, {("position", False)}),
        (sticky, {("position", True)}),
        # Friction as a function of speed is an odd force as a function of velocity.
        pytest.param(notch, {("speed", True), ("velocity", False)}, marks=pytest.mark.nightly),
    ],
    ids=["magnet", "friction at a position", "resistance at a speed"],
)
def test_a_force_that_depends_on_the_state_is_found_with_its_variable(
    tmp_path: Path, hidden: Hidden, accepted: set[tuple[str, bool]]
) -> None:
    laws = fitted_laws(tmp_path, hidden)
    (law,) = laws.laws
    assert (law.curve.variable.name, law.curve.is_friction) in accepted
    assert removed(tmp_path, hidden, laws) > 0.9


def test_a_spring_with_hysteresis_is_found_as_a_force_and_a_friction(tmp_path: Path) -> None:
    laws = fitted_laws(tmp_path, rubber)
    assert {law.curve.is_friction for law in laws.laws} == {False, True}
    assert removed(tmp_path, rubber, laws) > 0.9


@pytest.mark.parametrize("hidden", [push, push_in_one, random_torque])
def test_a_force_that_depends_on_time_is_refused(tmp_path: Path, hidden: Hidden) -> None:
    laws = fitted_laws(tmp_path, hidden)
    assert not laws.laws
    (note,) = laws.notes
    assert "A push in time or a random torque looks like this" in note
    assert f"({100 * FREE_LAWS.removes:.0f} % required)" in note


def test_no_law_is_found_if_the_linearized_motion_diverges(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in windows under effort commands with finite simulations and infinite gradients."""

    class Diverging(Linearization):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args)
            finite = self.readings.bin_means
            self.readings.bin_means = lambda columns: [
                np.full_like(x, np.inf) for x in finite(columns)
            ]

    monkeypatch.setattr(table_fit, "Linearization", Diverging)
    assert not fitted_laws(tmp_path, notch).laws


def test_the_fitted_curve_equals_the_hidden_force_within_its_confidence_band(
    tmp_path: Path,
) -> None:
    (law,) = fitted_laws(tmp_path, magnet).laws
    curve = law.curve
    often = curve.occupancy > 0.2 / len(curve.knots)
    truth = magnet(0.0, curve.knots, curve.knots)
    error = np.abs(curve.values - truth)[often]
    assert error.max() < 0.1 * np.abs(truth).max()
    assert np.mean(error <= curve.half_width[often] + 0.02) > 0.8
    assert "a pull towards 0.25 rad" in law.words


def search_without_findings(prepared: PreparedProblem, trials: TrialSet) -> SearchResult:
    """The result of a search that found no effect."""
    problem = prepared.problem
    left = residuals_everywhere(problem, EMPTY)
    errors = joint_errors(prepared, left, left)
    return SearchResult(
        prepared,
        trials,
        0,
        Explanation((), EMPTY),
        left,
        left,
        errors,
        "unexplained",
    )


def test_a_law_is_tested_on_held_out_recordings_then_written_and_replayed(tmp_path: Path) -> None:
    """A replay with the written table has the reported error on the held-out recordings."""
    realization = load((record(tmp_path, magnet)[0].parent) / "model.xml")
    whole, trials = prepared_case(tmp_path, magnet, None)
    setup = ModelSetup.of(realization, None, 1)
    fit_only = replace(trials, held_out=())
    fitted, kept = build_problem(setup, fit_only, [], scales=whole.problem.scales)
    laws = fit_laws_to_residual(setup, search_without_findings(fitted, kept), None)
    tested = confirm_on_test(laws, fitted.problem, search_without_findings(whole, trials))
    ((law, gain),) = tested.laws
    assert gain > 0.9
    early = confirm_on_test(
        laws, fitted.problem, search_without_findings(whole, trials), searched_all=False
    )
    assert [law.confidence for law, _ in early.laws] == [0.5]
    assert "a known effect may explain what the fitted law does" in early.notes[0]
    assert tested.tested.errors[JOINT].after < 0.2 * tested.tested.errors[JOINT].before
    (finding,) = tested.findings_json
    assert (finding["effect"], finding["joint"]) == ("unnamed_law", JOINT)
    of_finding = load_schema("results/diagnosis.schema.json")["properties"]["findings"]["items"]
    jsonschema.validate(finding, of_finding)
    assert finding["law"]["variable"] == "position"
    assert (
        len(finding["law"]["knots"]) == len(finding["law"]["values"]) == len(finding["law"]["band"])
    )
    low, high = finding["parameters"]["peak_force"]["ci95"]
    assert low < finding["parameters"]["peak_force"]["value"] < high
    assert "a pull towards 0.25 rad" in finding_sentence(finding)
    assert b"<svg" in law_figure(finding["law"], JOINT)
    folder = tmp_path / "patched"
    folder.mkdir()
    write_realization(folder, realization, fitted.problem, tested.hypothesis)
    patched = read_effects(folder / "effects.json")
    (written,) = patched.outside_mjcf
    assert UnnamedLaw().variable(written.values).name == "position"
    table = json.loads((folder / "effects.json").read_text())["effects"][0]["table"]
    assert table["outside"] == "no force"
    assert table["range"] == pytest.approx(law.curve.valid)
    predicted = replay_patched(load(folder / "model.xml"), patched, trials.held_out, threads=1)
    error = [p.position - t.position for p, t in zip(predicted, trials.held_out, strict=True)]
    rms = float(np.sqrt(np.mean(np.concatenate(error) ** 2)))
    assert rms == pytest.approx(tested.tested.errors[JOINT].after, rel=0.05)


def test_a_replay_outside_the_range_of_a_law_is_reported(tmp_path: Path) -> None:
    record(tmp_path, magnet, seconds=0.1, count=1)
    law = UnnamedLaw()
    values = law.parameters_of(POSITION, (0.0, 1.0), (0.0, 1.0), np.ones(KNOTS))
    patched = PatchedModel((JOINT,), (AppliedEffect(law.id, JOINT, values, is_in_mjcf=False),))
    time = np.arange(0.0, 2.0, 0.1)
    inside, beyond = np.full((20, 1), 0.5), np.linspace(0.05, 2.0, 20)[:, None]
    realization = load(tmp_path / "model.xml")
    reports = [
        describe_range_exits(realization, patched, time, Predicted(q, 0.0 * q, 0.0 * q))
        for q in (inside, beyond)
    ]
    assert reports[0] == ()
    assert reports[1] == (
        "joint elbow leaves the range in which its unnamed law is known (position 0 to 1 rad) for "
        "0.9 s: no force is added there",
    )


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("variable", "moon phase", "variable: position, velocity, command"),
        ("values", [0.0], "values: 64 finite numbers"),
        ("knots", [0.0] * 64, "knots: ascending, at equal distances"),
        ("range", None, "range: 2 finite numbers"),
    ],
)
def test_the_error_for_an_invalid_table_names_its_field(
    field: str, value: object, expected: str
) -> None:
    law = UnnamedLaw()
    values = law.parameters_of(POSITION, (0.0, 1.0), (0.0, 1.0), np.ones(KNOTS))
    table = law.table_of(values)
    assert law.read_table(table) == pytest.approx(values)
    with pytest.raises(ValueError, match=expected):
        law.read_table({**table, field: value})
