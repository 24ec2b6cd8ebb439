"""All that every drive has, fitted at once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_windows import ONE, hunting

from pytest_twin.diagnosis.findings import Explained
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.prepare import Prepared, prepare
from pytest_twin.diagnosis.search import cma_es_fit
from pytest_twin.diagnosis.search.full_drive_model import (
    fit_all_terms,
    weigh_by_removal,
    with_all_drive_terms,
)
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.scored_model import SelectedModel
from pytest_twin.diagnosis.search.stepwise_selection import StepwiseSelection
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

DRY, VISCOUS, DELAY = 0.03, 0.04, 0.004
RUBS = Term("coulomb_friction", 0)


def rubbing_alone(prepared: Prepared, trials: TrialSet) -> SearchResult:
    """What a search is that named dry friction and nothing else."""
    problem = prepared.problem
    selection = StepwiseSelection(problem)
    size = DRY / problem.scales.value(RUBS.parameters[0], 0)
    alone = EMPTY.with_term(RUBS, np.array([size]))
    best = selection.comparison.score_without_fit(alone, slopes=True)
    chosen = SelectedModel(best, selection.comparison.nominal)
    chosen.weigh({((RUBS,), Term("viscous_friction", 0)): -1.0})
    found = conclude(prepared, trials, selection, chosen)
    return replace(found, selected=chosen, explained=Explained((), alone))


def test_every_law_of_a_drive_is_added_once_and_at_nothing(tmp_path: Path) -> None:
    realization, trials = hunting(tmp_path)
    problem = prepare(realization, trials.fit, trials.held_out, threads=1).problem
    known = EMPTY.with_term(RUBS, np.array([0.3])).with_term(Term("payload", -1), np.zeros(5))
    more = with_all_drive_terms(problem, known, 0)
    drive = {effect for effect, law in catalogue().items() if law.common_to_geared_motors}
    assert {t.effect for t in more.terms} == drive | {"payload"}
    assert len(set(more.terms)) == len(more.terms)
    assert more.theta[more.slice_of(RUBS)] == [0.3]
    assert more.terms[:2] == known.terms
    # Nothing that was added moves anything.
    two = problem.residuals([known, more], problem.fit)
    assert np.allclose(two[0], two[1], atol=1e-9)


def test_a_drive_is_named_with_what_it_has_and_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Searches named dry friction alone, on a pendulum that has two more."""
    monkeypatch.setattr(cma_es_fit, "_EVALUATIONS", 16)
    realization, trials = hunting(tmp_path, seconds=2.0, dry=DRY, viscous=VISCOUS, delay=DELAY)
    whole, cut, longer = (
        prepare(realization, trials.fit, trials.held_out, threads=1, window=window)
        for window in (None, WINDOW, 1.0)
    )
    found, other = (rubbing_alone(prepared, trials) for prepared in (whole, cut))
    named = refit_with_full_drive(found, other, longer)
    by_effect = {f.effect: f for f in named.explained.findings}
    assert {"coulomb_friction", "viscous_friction", "command_delay"} <= set(by_effect)
    assert len(by_effect) <= 5
    for effect, parameter, truth in (
        ("coulomb_friction", "coulomb", DRY),
        ("viscous_friction", "coefficient", VISCOUS),
        ("command_delay", "delay", DELAY),
    ):
        assert by_effect[effect].parameters[parameter].value == pytest.approx(truth, rel=0.2)
    assert named.verdict == "explained"
    # What else could stand in the place of a name was asked of the one that a search found.
    known = 1.0 / (1.0 + np.exp(-1.0))
    for effect, finding in by_effect.items():
        if effect == "coulomb_friction":
            assert finding.confidence == pytest.approx(known)
            assert [a.effect for a in finding.alternatives] == ["viscous_friction"]
        else:
            assert finding.confidence <= 0.5
    assert named.prepared is whole


def test_what_is_not_missed_is_less_likely_than_even(tmp_path: Path) -> None:
    realization, trials = hunting(tmp_path, dry=DRY)
    problem = prepare(realization, trials.fit, trials.held_out, threads=1, window=WINDOW).problem
    comparison = ModelComparison(problem)
    inert = Term("armature", 0)
    both = Hypothesis((RUBS, inert), np.array([0.1, 0.0]))
    best = fit_all_terms(comparison, both)
    selected = weigh_by_removal(comparison, best, {RUBS: -9.0, inert: 3.0})
    assert selected.best is best
    assert selected.confidence[RUBS] == 0.5
    assert selected.confidence[inert] == pytest.approx(1.0 / (1.0 + np.exp(3.0)))
    assert selected.alternatives == {RUBS: [], inert: []}


def test_a_joint_slips_that_rubs_and_keeps_a_lot(tmp_path: Path) -> None:
    realization, trials = hunting(tmp_path, seconds=2.0, dry=DRY)
    prepared = prepare(realization, trials.fit, trials.held_out, threads=1)
    found = search(prepared, trials, StepwiseSelection(prepared.problem))
    assert prepared.problem.joints == ONE
    assert not found.has_stick_slip
    for times, terms, slips in ((11.0, (RUBS,), True), (9.0, (RUBS,), False), (11.0, (), False)):
        kept = JointError(1.0, times * 0.01, 0.01, "rad")
        explained = Explained((), Hypothesis(terms, np.full(len(terms), 0.1)))
        assert replace(found, errors={"left": kept}, explained=explained).has_stick_slip is slips
