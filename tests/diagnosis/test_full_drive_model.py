"""Fit of all effects that every geared drive has, without a selection."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_windows import ONE, one_pendulum

from pytest_twin.diagnosis.effect_selection import EffectSelection
from pytest_twin.diagnosis.findings import Explanation
from pytest_twin.diagnosis.prepare import PreparedProblem, prepare
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search import cma_es_fit
from pytest_twin.diagnosis.search.full_drive_model import (
    fit_all_terms,
    weigh_by_removal,
    with_all_drive_terms,
)
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.scored_model import SelectedModel
from pytest_twin.diagnosis.search_result import (
    SearchResult,
    conclude,
    refit_with_full_drive,
    search,
)
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict import JointError
from pytest_twin.diagnosis.windows import WINDOW
from pytest_twin.effects import catalogue
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term

DRY, VISCOUS, DELAY = 0.03, 0.04, 0.004
DRY_FRICTION = Term("coulomb_friction", 0)


def result_with_dry_friction_only(prepared: PreparedProblem, trials: TrialSet) -> SearchResult:
    """The result of a search that found dry friction only."""
    problem = prepared.problem
    selection = EffectSelection(problem)
    size = DRY / problem.scales.value(DRY_FRICTION.parameters[0], 0)
    alone = EMPTY.with_term(DRY_FRICTION, np.array([size]))
    best = selection.comparison.score_without_fit(alone, slopes=True)
    chosen = SelectedModel(best, selection.comparison.nominal)
    chosen.weigh({((DRY_FRICTION,), Term("viscous_friction", 0)): -1.0})
    found = conclude(prepared, trials, selection.diagnosis_run, chosen)
    return replace(found, selected=chosen, explanation=Explanation((), alone))


def test_an_effect_that_was_compared_with_nothing_in_time_is_kept_with_low_confidence(
    tmp_path: Path,
) -> None:
    """The pendulum also has viscous friction, which the search did not come to."""
    realization, trials = one_pendulum(tmp_path, seconds=1.4, dry=DRY, viscous=VISCOUS)
    prepared = prepare(realization, trials.fit, trials.held_out, threads=1)
    run = Run()
    selection = EffectSelection(prepared.problem, run)
    size = DRY / prepared.problem.scales.value(DRY_FRICTION.parameters[0], 0)
    alone = EMPTY.with_term(DRY_FRICTION, np.array([size]))
    best = selection.comparison.score_without_fit(alone, slopes=True)
    run.budget.stop()
    chosen = SelectedModel(best, selection.comparison.nominal)
    found = conclude(prepared, trials, selection.diagnosis_run, chosen)
    (finding,) = found.explanation.findings
    assert (finding.effect, finding.confidence) == ("coulomb_friction", 0.5)
    assert found.verdict == "improved", found.pruned.notes


def test_each_drive_effect_is_added_once_with_its_neutral_value(tmp_path: Path) -> None:
    realization, trials = one_pendulum(tmp_path)
    problem = prepare(realization, trials.fit, trials.held_out, threads=1).problem
    known = EMPTY.with_term(DRY_FRICTION, np.array([0.3])).with_term(
        Term("payload", -1), np.zeros(5)
    )
    extended = with_all_drive_terms(problem, known, 0)
    drive = {effect for effect, law in catalogue().items() if law.common_to_geared_motors}
    assert {t.effect for t in extended.terms} == drive | {"payload"}
    assert len(set(extended.terms)) == len(extended.terms)
    assert extended.theta[extended.slice_of(DRY_FRICTION)] == [0.3]
    assert extended.terms[:2] == known.terms
    # The added effects do not change the prediction.
    two = problem.residuals([known, extended], problem.fit)
    assert np.allclose(two[0], two[1], atol=1e-9)


def test_all_drive_parameters_are_fitted_together_and_the_absent_ones_pruned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The search found dry friction only; the pendulum also has viscous friction and a delay."""
    monkeypatch.setattr(cma_es_fit, "_EVALUATIONS", 16)
    realization, trials = one_pendulum(tmp_path, seconds=1.4, dry=DRY, viscous=VISCOUS, delay=DELAY)
    whole, cut, longer = (
        prepare(realization, trials.fit, trials.held_out, threads=1, window=window)
        for window in (None, WINDOW, 1.0)
    )
    found, other = (result_with_dry_friction_only(prepared, trials) for prepared in (whole, cut))
    named = refit_with_full_drive(found, other, longer)
    by_effect = {f.effect: f for f in named.explanation.findings}
    assert {"coulomb_friction", "viscous_friction", "command_delay"} <= set(by_effect)
    assert len(by_effect) <= 5
    for effect, parameter, truth in (
        ("coulomb_friction", "coulomb", DRY),
        ("viscous_friction", "coefficient", VISCOUS),
        ("command_delay", "delay", DELAY),
    ):
        assert by_effect[effect].parameters[parameter].value == pytest.approx(truth, rel=0.2)
    assert named.verdict == "explained"
    # Only the effect of the search was compared with alternatives.
    known = 1.0 / (1.0 + np.exp(-1.0))
    for effect, finding in by_effect.items():
        if effect == "coulomb_friction":
            assert finding.confidence == pytest.approx(known)
            assert [a.effect for a in finding.alternatives] == ["viscous_friction"]
        else:
            assert finding.confidence <= 0.5
    assert named.prepared is whole


def test_the_confidence_of_a_drive_effect_is_at_most_half_and_less_if_its_removal_gains_evidence(
    tmp_path: Path,
) -> None:
    realization, trials = one_pendulum(tmp_path, dry=DRY)
    problem = prepare(realization, trials.fit, trials.held_out, threads=1, window=WINDOW).problem
    comparison = ModelComparison(problem)
    unneeded = Term("armature", 0)
    both = Hypothesis((DRY_FRICTION, unneeded), np.array([0.1, 0.0]))
    best = fit_all_terms(comparison, both)
    selected = weigh_by_removal(comparison, best, {DRY_FRICTION: -9.0, unneeded: 3.0})
    assert selected.best is best
    assert selected.confidence[DRY_FRICTION] == 0.5
    assert selected.confidence[unneeded] == pytest.approx(1.0 / (1.0 + np.exp(3.0)))
    assert selected.alternatives == {DRY_FRICTION: [], unneeded: []}


def test_stick_slip_needs_a_friction_effect_and_a_residual_above_ten_floors(tmp_path: Path) -> None:
    realization, trials = one_pendulum(tmp_path, seconds=1.4, dry=DRY)
    prepared = prepare(realization, trials.fit, trials.held_out, threads=1)
    found = search(prepared, trials, EffectSelection(prepared.problem))
    assert prepared.problem.joints == ONE
    assert not found.has_stick_slip
    for times, terms, stick_slip in (
        (11.0, (DRY_FRICTION,), True),
        (9.0, (DRY_FRICTION,), False),
        (11.0, (), False),
    ):
        kept = JointError(1.0, times * 0.01, 0.01, "rad")
        explanation = Explanation((), Hypothesis(terms, np.full(len(terms), 0.1)))
        assert (
            replace(found, errors={"left": kept}, explanation=explanation).has_stick_slip
            is stick_slip
        )
