"""Forces that no effect with a name explains: what is a function of the state is found, what is not
is refused.
"""

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

from pytest_twin.diagnosis.findings import Explained
from pytest_twin.diagnosis.hypothesis import EMPTY
from pytest_twin.diagnosis.locate import Where
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.patched.model import AppliedEffect, Patched, read_effects
from pytest_twin.diagnosis.patched.ranges import outside_in_words
from pytest_twin.diagnosis.patched.replay import replay_patched
from pytest_twin.diagnosis.patched.write import write_realization
from pytest_twin.diagnosis.prepare import Prepared
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.pruning import PrunedModel
from pytest_twin.diagnosis.search.scored_model import SelectedModel
from pytest_twin.diagnosis.search_result import (
    SearchResult,
    build_problem,
    joint_errors,
    residuals_everywhere,
)
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.diagnosis.unnamed_law import simulated
from pytest_twin.diagnosis.unnamed_law.fit import WORTH, FreeLaws, free_laws
from pytest_twin.diagnosis.unnamed_law.regression import Regression
from pytest_twin.diagnosis.unnamed_law.tested import laws_left, on_test
from pytest_twin.effects.segment import Predicted
from pytest_twin.effects.unnamed_law import KNOTS, POSITION, UnnamedLaw
from pytest_twin.formats.schema import load_schema
from pytest_twin.realization import load
from pytest_twin.report.finding_words import finding_sentence
from pytest_twin.report.law_plot import law_figure

TOPICS = {"state": "/joint_states", "command": "/joint_commands"}
AT = 0.25
"""rad, of what acts in one place."""


def magnet(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A pull towards a pose."""
    x = (q - AT) / 0.06
    return -0.5 * x * np.exp(0.5 - x * x / 2.0)


def sticky(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A stretch that rubs."""
    return -0.6 * np.tanh(v / 0.01) * np.exp(-(((q - AT) / 0.1) ** 2))


def rubber(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A spring that acts beyond a pose and loses a part of its work."""
    return -(2.0 + np.tanh(v / 0.01)) * np.maximum(q - AT, 0.0)


def notch(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A resistance at one speed."""
    return -0.5 * np.sign(v) * np.exp(-(((np.abs(v) - 1.2) / 0.25) ** 2))


def push(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The same push in every recording, at the same time."""
    return np.full_like(q, 0.6 * np.sin(np.pi * (t - 3.0) / 1.5) if 3.0 < t < 4.5 else 0.0)


def push_in_one(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A push in one recording alone."""
    out = push(t, q, v)
    out[1:] = 0.0
    return out


def random_torque(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Noise with a correlation time of 0.2 s, of its own in each recording."""
    return WALK[min(int(t / STEP), len(WALK) - 1), : len(q)]


def _walk(steps: int, recordings: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    out, keep = np.zeros((steps, recordings)), np.exp(-STEP / 0.2)
    for k in range(1, steps):
        noise = rng.standard_normal(recordings)
        out[k] = keep * out[k - 1] + 0.4 * np.sqrt(1.0 - keep**2) * noise
    return out


WALK = _walk(round(10.0 / STEP), 5)


def posed(folder: Path, hidden: Hidden, window: float | None) -> tuple[Prepared, TrialSet]:
    paths = sorted(folder.glob("*.mcap")) or record(folder, hidden)
    realization = load(folder / "model.xml")
    trials = read_trials(paths, [], TOPICS, realization.structure)
    return build_problem(ModelSetup.of(realization, None, 1), trials, [], window=window)


def found(folder: Path, hidden: Hidden) -> FreeLaws:
    """What is found from the fit recordings, without a search before."""
    near, _ = posed(folder, hidden, 0.5)
    with np.errstate(over="ignore", invalid="ignore"):
        return free_laws(near, EMPTY, {JOINT: Where("", {})}, near.problem.fit)


def removed(folder: Path, hidden: Hidden, laws: FreeLaws) -> float:
    """Share of the squared error of the held-out recordings that is gone."""
    problem = posed(folder, hidden, None)[0].problem
    before, after = problem.errors([EMPTY, laws.hypothesis], problem.held_out)
    return 1.0 - float(np.sum(after**2) / np.sum(before**2))


@pytest.mark.parametrize(
    ("hidden", "alike"),
    [
        (magnet, {("position", False)}),
        (sticky, {("position", True)}),
        # Friction over speed is an odd force over velocity.
        (notch, {("speed", True), ("velocity", False)}),
    ],
)
def test_a_function_of_the_state_is_found_over_its_variable(
    tmp_path: Path, hidden: Hidden, alike: set[tuple[str, bool]]
) -> None:
    laws = found(tmp_path, hidden)
    (law,) = laws.laws
    assert (law.curve.variable.name, law.curve.is_friction) in alike
    assert removed(tmp_path, hidden, laws) > 0.9


def test_a_spring_with_hysteresis_is_a_force_and_a_friction(tmp_path: Path) -> None:
    laws = found(tmp_path, rubber)
    assert {law.curve.is_friction for law in laws.laws} == {False, True}
    assert removed(tmp_path, rubber, laws) > 0.9


@pytest.mark.parametrize("hidden", [push, push_in_one, random_torque])
def test_a_force_in_time_is_no_law(tmp_path: Path, hidden: Hidden) -> None:
    laws = found(tmp_path, hidden)
    assert not laws.laws
    (note,) = laws.notes
    assert "A push in time or a random torque looks like this" in note
    assert f"({100 * WORTH:.0f} % required)" in note


def test_a_linearized_motion_that_runs_away_is_no_law(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Windows of a slide under effort commands: simulations were finite, slopes were not."""
    around = simulated._around

    def overflown(*args: Any) -> Regression:
        sums = around(*args)
        return replace(sums, gram=np.full_like(sums.gram, np.inf))

    monkeypatch.setattr(simulated, "_around", overflown)
    assert not found(tmp_path, notch).laws


def test_the_curve_is_the_hidden_force_within_its_band(tmp_path: Path) -> None:
    (law,) = found(tmp_path, magnet).laws
    curve = law.curve
    often = curve.occupancy > 0.2 / len(curve.knots)
    truth = magnet(0.0, curve.knots, curve.knots)
    off = np.abs(curve.values - truth)[often]
    assert off.max() < 0.1 * np.abs(truth).max()
    assert np.mean(off <= curve.half_width[often] + 0.02) > 0.8
    assert "a pull towards 0.25 rad" in law.words


def nothing_found(prepared: Prepared, trials: TrialSet) -> SearchResult:
    """A search that came to nothing."""
    problem = prepared.problem
    nominal = ModelComparison(problem).nominal
    left = residuals_everywhere(problem, EMPTY)
    errors = joint_errors(prepared, left, left)
    return SearchResult(
        prepared,
        trials,
        SelectedModel(nominal, nominal),
        PrunedModel(nominal.fitted, [], []),
        Explained((), EMPTY),
        left,
        left,
        errors,
        "unexplained",
    )


def test_a_law_is_tested_written_read_and_replayed(tmp_path: Path) -> None:
    """Its table in the realization predicts the held-out recordings as the diagnosis says."""
    realization = load((record(tmp_path, magnet)[0].parent) / "model.xml")
    whole, trials = posed(tmp_path, magnet, None)
    given = ModelSetup.of(realization, None, 1)
    fit_only = replace(trials, held_out=())
    fitted, kept = build_problem(given, fit_only, [], scales=whole.problem.scales)
    laws = laws_left(given, nothing_found(fitted, kept), None)
    tested = on_test(laws, fitted.problem, nothing_found(whole, trials))
    ((law, gain),) = tested.laws
    assert gain > 0.9
    early = on_test(laws, fitted.problem, nothing_found(whole, trials), searched_all=False)
    assert [law.confidence for law, _ in early.laws] == [0.5]
    assert "a known effect may explain what the fitted law does" in early.notes[0]
    assert tested.tested.errors[JOINT].after < 0.2 * tested.tested.errors[JOINT].before
    (said,) = tested.findings_json
    assert (said["effect"], said["joint"]) == ("unnamed_law", JOINT)
    of_finding = load_schema("results/diagnosis.schema.json")["properties"]["findings"]["items"]
    jsonschema.validate(said, of_finding)
    assert said["law"]["variable"] == "position"
    assert len(said["law"]["knots"]) == len(said["law"]["values"]) == len(said["law"]["band"])
    low, high = said["parameters"]["peak_force"]["ci95"]
    assert low < said["parameters"]["peak_force"]["value"] < high
    assert "a pull towards 0.25 rad" in finding_sentence(said)
    assert b"<svg" in law_figure(said["law"], JOINT)
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
    off = [p.position - t.position for p, t in zip(predicted, trials.held_out, strict=True)]
    rms = float(np.sqrt(np.mean(np.concatenate(off) ** 2)))
    assert rms == pytest.approx(tested.tested.errors[JOINT].after, rel=0.05)


def test_a_replay_beyond_the_range_of_a_table_says_so(tmp_path: Path) -> None:
    record(tmp_path, magnet, seconds=0.1, count=1)
    law = UnnamedLaw()
    values = law.parameters_of(POSITION, (0.0, 1.0), (0.0, 1.0), np.ones(KNOTS))
    patched = Patched((JOINT,), (AppliedEffect(law.id, JOINT, values, is_in_mjcf=False),))
    time = np.arange(0.0, 2.0, 0.1)
    inside, beyond = np.full((20, 1), 0.5), np.linspace(0.05, 2.0, 20)[:, None]
    realization = load(tmp_path / "model.xml")
    said = [
        outside_in_words(realization, patched, time, Predicted(q, 0.0 * q, 0.0 * q))
        for q in (inside, beyond)
    ]
    assert said[0] == ()
    assert said[1] == (
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
def test_a_table_that_cannot_be_used_names_its_field(
    field: str, value: object, expected: str
) -> None:
    law = UnnamedLaw()
    values = law.parameters_of(POSITION, (0.0, 1.0), (0.0, 1.0), np.ones(KNOTS))
    table = law.table_of(values)
    assert law.read_table(table) == pytest.approx(values)
    with pytest.raises(ValueError, match=expected):
        law.read_table({**table, field: value})
