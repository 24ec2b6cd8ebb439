"""Pruning: which effects are rejected, and when a search ends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from two_pendulums import mjcf, record

from pytest_twin.diagnosis.effect_selection import EffectSelection
from pytest_twin.diagnosis.findings import build_explanation
from pytest_twin.diagnosis.intervals import ParameterUncertainty
from pytest_twin.diagnosis.prepare import PreparedProblem, prepare
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search import model_comparison
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.pruning import prune, prune_by_likelihood
from pytest_twin.diagnosis.search.pruning_rules import (
    RefitComparison,
    alternatives_more_likely,
    at_bound_or_in_doubt,
    is_in_doubt,
    may_be_absent,
    removes_too_little,
    residual_remains,
    share_too_large,
    wrong_position_dependence,
)
from pytest_twin.diagnosis.search.scored_model import ScoredModel, SelectedModel
from pytest_twin.diagnosis.search.settings import ComparisonSettings
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel, fit
from pytest_twin.formats.mcap import read_recording
from pytest_twin.loaded_model import load_model
from pytest_twin.trial import Trial, make_trial


def prepared_case(folder: Path, **hidden: float) -> tuple[PreparedProblem, list[Trial]]:
    """Two pendulums with hidden effects at one; the second recording is held out."""
    (folder / "model.xml").write_text(mjcf())
    realization = load_model(folder / "model.xml").realization
    trials = [
        make_trial(
            read_recording(record(folder / f"{seed}.mcap", seed, seconds=1.2, **hidden)),
            realization.structure,
        )
        for seed in (1, 2)
    ]
    return prepare(realization, trials[:1], trials[1:], threads=1), trials


def selected_term(
    prepared: PreparedProblem, term: Term, start: float, *, fitted: bool = True
) -> SelectedModel:
    """The result of a search that selected one term."""
    problem = prepared.problem
    weights = 1.0 / problem.signal_floor

    def rival(hypothesis: Hypothesis, iterations: int) -> ScoredModel:
        found = fit(problem, [hypothesis], weights, problem.fit, iterations=iterations)[0]
        held = problem.residuals([found.hypothesis], problem.held_out)[0]
        return ScoredModel(found, held, problem)

    best = rival(EMPTY.with_term(term, np.array([start])), 8 if fitted else 0)
    return SelectedModel(best, rival(EMPTY, 0), confidence={term: 1.0})


def refit_comparison(
    problem: Problem,
    fitted: FittedModel,
    *floors: Sequence[float],
    confidence: Mapping[Term, float] | None = None,
) -> RefitComparison:
    """A fit of one term with these errors of each joint in floors: nominal, with it, without it."""
    before, base, rest = (np.array(each) for each in floors)
    weights = 1.0 / problem.signal_floor
    return RefitComparison(
        problem, fitted, confidence or {}, before, base, [fitted], [rest], weights
    )


def refit_of_first_joint(
    problem: Problem, fitted: FittedModel, left: float, without: float, nominal: float = 100.0
) -> RefitComparison:
    """A fit at the first joint with these errors in floors."""
    return refit_comparison(problem, fitted, (nominal, 1.0), (left, 1.0), (without, 1.0))


def with_sizes(problem: Problem, terms: Sequence[Term], sizes: Sequence[float]) -> Hypothesis:
    """Effects with these values (SI units); categorical parameters have their first value."""
    found = EMPTY
    for term, size in zip(terms, sizes, strict=True):
        (parameter,) = (p for p in term.parameters if not p.choice)
        theta = [
            p.starts[0] if p.choice else size / problem.scales.value(parameter, 0)
            for p in term.parameters
        ]
        found = found.with_term(term, np.array(theta))
    return found


def test_the_least_effect_of_a_model_that_diverges_is_rejected(tmp_path: Path) -> None:
    prepared, _ = prepared_case(tmp_path, viscous=0.6)
    problem, term = prepared.problem, Term("viscous_friction", 0)
    fitted = selected_term(prepared, term, 0.5).best.fitted
    diverging = refit_comparison(problem, fitted, (100.0, 1.0), (np.inf, 1.0), (100.0, 1.0))
    assert list(removes_too_little(diverging).values()) == [
        "rejected: viscous_friction at left: the simulation diverges with it"
    ]


def test_an_effect_at_its_physical_bound_with_a_large_residual_is_rejected(tmp_path: Path) -> None:
    """Dry friction at its bound removes three quarters of the error of viscous friction."""
    prepared, trials = prepared_case(tmp_path, viscous=0.6)
    term = Term("coulomb_friction", 0)
    selected = selected_term(prepared, term, term.parameters[0].upper, fitted=False)
    found = build_explanation(prepared, selected, prune(prepared.problem, selected), trials)
    assert not found.findings
    assert any("coulomb_friction at left" in n and "physical bound" in n for n in found.notes)


@pytest.mark.parametrize(
    ("speed", "is_accepted"),
    [(0.1, True), (0.003, False), (3.0, False)],
    ids=["inside", "low", "high"],
)
def test_an_effect_with_a_shape_parameter_at_its_bound_and_a_large_residual_is_rejected(
    tmp_path: Path, speed: float, is_accepted: bool
) -> None:
    """A Stribeck velocity at an end of its range indicates another cause."""
    prepared, _ = prepared_case(tmp_path, viscous=0.6)
    problem, term = prepared.problem, Term("stribeck_friction", 0)
    shaped = EMPTY.with_term(term, np.array([1.0, 0.5, speed]))
    assert not shaped.is_at_bound(term)
    weights = 1.0 / problem.signal_floor
    fitted = fit(problem, [shaped], weights, problem.fit, iterations=0, slopes=True)[0]

    def rejected(left: float) -> list[Term]:
        tested = refit_of_first_joint(problem, fitted, left, without=left)
        return [tested.terms[k] for k in at_bound_or_in_doubt(tested)]

    assert rejected(40.0) == ([] if is_accepted else [term])
    # If it explains its joint, it is accepted.
    assert rejected(2.0) == []


@pytest.mark.parametrize(
    ("confidence", "rival", "is_accepted"),
    [(0.48, 0.5, True), (0.4, 0.6, True), (0.4, 0.3, True), (0.2, 0.7, False)],
)
def test_an_effect_is_rejected_only_if_an_alternative_is_clearly_more_likely(
    tmp_path: Path, confidence: float, rival: float, is_accepted: bool
) -> None:
    """Scale error and eccentricity of an encoder, for example, are equal over a small angle."""
    prepared, _ = prepared_case(tmp_path, viscous=0.6)
    problem, term = prepared.problem, Term("viscous_friction", 0)
    hypothesis = with_sizes(problem, [term], [0.6])
    weights = 1.0 / problem.signal_floor
    fitted = fit(problem, [hypothesis], weights, problem.fit, iterations=0, slopes=True)[0]
    tested = replace(
        refit_comparison(
            problem, fitted, (100.0, 1.0), (20.0, 1.0), (90.0, 1.0), confidence={term: confidence}
        ),
        likeliest_alternative={term: rival},
    )
    rejections = at_bound_or_in_doubt(tested)
    assert not rejections if is_accepted else "other effects are more likely" in rejections[0]
    # Where the time did not suffice to simulate the alternatives, they reject nothing.
    unproven = replace(tested, not_simulated=frozenset({term}))
    assert not at_bound_or_in_doubt(unproven)


@pytest.mark.parametrize(
    ("distance", "without", "is_accepted"),
    [
        pytest.param(0.1, 2.0, True, id="longer distance"),
        pytest.param(0.0, 2.0, False, id="shortest distance, two noise floors"),
        pytest.param(0.0, 4.0, True, id="shortest distance, four noise floors"),
    ],
)
def test_presliding_with_the_shortest_distance_must_remove_more_error(
    tmp_path: Path, distance: float, without: float, is_accepted: bool
) -> None:
    """With the shortest presliding distance, the law is hardly different from dry friction."""
    prepared, _ = prepared_case(tmp_path, viscous=0.6)
    problem, term = prepared.problem, Term("presliding_hysteresis", 0)
    size, length = term.parameters
    start = EMPTY.with_term(term, np.array([size.starts[0], max(distance, length.lower)]))
    weights = 1.0 / problem.signal_floor
    (fitted,) = fit(problem, [start], weights, problem.fit, iterations=0, slopes=True)
    well_known = replace(fitted, jacobian=100.0 * fitted.jacobian)
    tested = refit_of_first_joint(problem, well_known, 1.0, without, nominal=10.0)
    assert not may_be_absent(well_known, term, tested.uncertainty)
    rejections = removes_too_little(tested)
    assert list(rejections) == ([] if is_accepted else [0])
    for note in rejections.values():
        assert note == (
            "rejected: presliding_hysteresis at left: it removes too little of the remaining "
            "error; a shape parameter is at its bound"
        )


@pytest.mark.parametrize(("without", "is_accepted"), [(50.0, False), (70.0, True)])
def test_an_effect_with_a_wide_interval_is_kept_if_the_residual_without_it_is_much_larger(
    tmp_path: Path, without: float, is_accepted: bool
) -> None:
    """To first order the prediction hardly depends on the effect; a refit without it decides."""
    prepared, _ = prepared_case(tmp_path, viscous=0.6)
    problem, term = prepared.problem, Term("viscous_friction", 0)
    start = with_sizes(problem, (term,), (0.6,))
    weights = 1.0 / problem.signal_floor
    fitted = fit(problem, [start], weights, problem.fit, iterations=0, slopes=True)[0]
    flat = replace(fitted, jacobian=1e-6 * fitted.jacobian)
    assert is_in_doubt(refit_of_first_joint(problem, flat, 40.0, without), 0) is not is_accepted

    def rejected(present_fit: FittedModel, without: float) -> list[Term]:
        tested = refit_of_first_joint(problem, present_fit, 40.0, without)
        return [tested.terms[k] for k in at_bound_or_in_doubt(tested)]

    assert rejected(flat, without) == ([] if is_accepted else [term])
    assert rejected(fitted, 40.0) == []


@pytest.mark.parametrize(
    ("slope", "without", "is_accepted"),
    [
        pytest.param(1e-6, 3.2, False, id="interval includes a rigid transmission"),
        pytest.param(1e-6, 4.0, True, id="interval includes a rigid one, larger error"),
        pytest.param(1e4, 3.2, True, id="interval excludes a rigid transmission"),
    ],
)
def test_an_elastic_transmission_whose_interval_includes_a_rigid_one_must_remove_more_error(
    tmp_path: Path, slope: float, without: float, is_accepted: bool
) -> None:
    prepared, _ = prepared_case(tmp_path, viscous=0.6)
    problem, term = prepared.problem, Term("joint_elasticity", 0)
    theta = [p.starts[0] if p.neutral is None else p.neutral for p in term.parameters]
    theta[term.amplitude_indices(np.array(theta))[0]] = 0.01
    weights = 1.0 / problem.signal_floor
    start = EMPTY.with_term(term, np.array(theta, dtype=float))
    (fitted,) = fit(problem, [start], weights, problem.fit, iterations=0, slopes=True)
    rescaled = replace(fitted, jacobian=slope * fitted.jacobian)
    tested = refit_of_first_joint(problem, rescaled, 2.0, without, nominal=10.0)
    rejections = removes_too_little(tested)
    assert list(rejections) == ([] if is_accepted else [0])
    for note in rejections.values():
        assert note.endswith("; its 95 % interval includes its absence")


@pytest.mark.parametrize(
    ("hidden", "left", "is_accepted"),
    [
        pytest.param({"magnet": 0.3}, 30.0, False, id="another dependence on position"),
        pytest.param({"magnet": 0.3}, 12.0, True, id="small residual"),
        pytest.param({"dry": 0.05}, 30.0, True, id="residual depends on velocity"),
    ],
)
def test_a_law_of_position_is_rejected_if_the_missing_force_still_depends_on_position(
    tmp_path: Path, hidden: dict[str, float], left: float, is_accepted: bool
) -> None:
    """A linear spring cannot represent a magnet, whose force decreases with distance."""
    prepared, _ = prepared_case(tmp_path, **hidden)
    problem, term = prepared.problem, Term("joint_spring", 0)
    weights = 1.0 / problem.signal_floor
    start = EMPTY.with_term(term, np.array([0.1, 0.0]))
    (fitted,) = fit(problem, [start], weights, problem.fit, iterations=8)
    rejections = wrong_position_dependence(
        refit_of_first_joint(problem, fitted, left, without=left)
    )
    assert list(rejections) == ([] if is_accepted else [0])
    for note in rejections.values():
        assert note.startswith("rejected: joint_spring at left, the closest known effect: ")
        assert "is still missing depends on the joint's position, so the true dependence" in note


@pytest.mark.parametrize(
    ("effect", "shape", "is_out"),
    [
        ("encoder_bias", 1.0, False),
        ("backlash", 0.0, False),
        ("backlash", 0.02, True),
        ("payload", 4.0, True),
        ("payload", 1.0, False),
    ],
)
def test_a_shape_parameter_of_zero_does_not_count_as_its_bound(
    effect: str, shape: float, is_out: bool
) -> None:
    """Rigid teeth are a special case; a payload at four times the reach is implausible."""
    term = Term(effect, 0)
    theta = np.zeros(len(term.parameters))
    theta[:2] = 0.01, shape
    assert EMPTY.with_term(term, theta).has_shape_at_bound(term) is is_out


def test_an_external_force_may_begin_and_end_with_the_trial() -> None:
    push = Term("external_force", 0)
    assert not EMPTY.with_term(push, np.array([0.5, 0.0, 12.0])).has_shape_at_bound(push)


def test_effects_that_were_found_in_windows_are_not_pruned_again(tmp_path: Path) -> None:
    """Pruning would reject the effect because of its large residual."""
    prepared, trials = prepared_case(tmp_path, viscous=0.6)
    term = Term("coulomb_friction", 0)
    selected = selected_term(prepared, term, 0.1)
    assert not prune(prepared.problem, selected).fitted.hypothesis.terms
    pruned = prune_by_likelihood(ModelComparison(prepared.problem), selected.best)
    assert [h.terms for h in pruned.reduced_models] == [()]
    (found,) = build_explanation(prepared, selected, pruned, trials).findings
    assert (found.effect, found.joint) == ("coulomb_friction", "left")


def test_an_effect_that_does_not_improve_whole_motions_is_rejected(tmp_path: Path) -> None:
    prepared, _ = prepared_case(tmp_path, viscous=0.3)
    problem = prepared.problem
    right, unneeded = Term("viscous_friction", 0), Term("quadratic_drag", 1)
    start = EMPTY.with_term(right, np.array([0.1])).with_term(unneeded, np.array([1e-3]))
    comparison = ModelComparison(problem)
    weights = 1.0 / problem.signal_floor
    (best,) = comparison.fit_models([start], comparison.nominal, 8, weights=weights, slopes=True)
    pruned = prune_by_likelihood(comparison, best)
    assert pruned.fitted.hypothesis.terms == (right,)
    assert [h.terms for h in pruned.reduced_models] == [()]
    assert pruned.fitted.jacobian.shape[-1] == 1
    assert pruned.notes == [
        "rejected: quadratic_drag at right: it reduces the error over whole recordings too little"
    ]


def test_an_effect_that_explains_the_whole_error_is_kept(tmp_path: Path) -> None:
    prepared, trials = prepared_case(tmp_path, viscous=0.3)
    selected = selected_term(prepared, Term("viscous_friction", 0), 0.1)
    found = build_explanation(prepared, selected, prune(prepared.problem, selected), trials)
    assert [(f.effect, f.joint) for f in found.findings] == [("viscous_friction", "left")]


def test_without_validation_recordings_an_effect_must_remove_more_error(tmp_path: Path) -> None:
    prepared, _ = prepared_case(tmp_path, viscous=0.003)
    problem = prepared.problem
    selected = selected_term(prepared, Term("viscous_friction", 0), 0.01)
    assert prune(problem, selected).fitted.hypothesis.terms
    pruned = prune(replace(problem, held_out=problem.held_out[:0]), selected)
    assert not pruned.fitted.hypothesis.terms
    assert pruned.notes == [
        "rejected: viscous_friction at left: it removes too little of the remaining error; only "
        "one recording shows it"
    ]


def test_a_search_adds_no_effects_when_its_simulations_are_used_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared, _ = prepared_case(tmp_path, delay=0.02)
    monkeypatch.setattr(model_comparison, "COMPARISON", ComparisonSettings(simulations=0))
    stepped = prepared.problem.simulated_steps
    selection = EffectSelection(prepared.problem)
    selected = selection.refine(selection.comparison.nominal)
    assert not selected.best.hypothesis.terms
    assert prepared.problem.simulated_steps - stepped < 10 * prepared.problem.simulator.steps.sum()


def test_effects_at_several_joints_allow_more_simulations(tmp_path: Path) -> None:
    prepared, _ = prepared_case(tmp_path, delay=0.02)
    problem = prepared.problem
    comparison = model_comparison.ModelComparison(problem)
    names = ("viscous_friction", "coulomb_friction", "armature", "joint_spring", "effort_bias")
    at_one_joint = [Term(name, 0) for name in names]
    at_two_joints = [*at_one_joint[:3], Term("viscous_friction", 1)]
    once, first = int(problem.simulator.steps.sum()), int(problem.simulator.steps[0])
    problem.simulator.count(np.zeros(475 * once // first, dtype=int))
    assert comparison.is_spent([])
    assert comparison.is_spent(at_one_joint), "effects at one joint must count as three at most"
    assert not comparison.is_spent(at_two_joints)
    problem.simulator.count(np.zeros(50 * once // first, dtype=int))
    assert comparison.is_spent(at_two_joints)


def test_findings_are_sorted_by_the_change_of_the_prediction_without_them(tmp_path: Path) -> None:
    """Friction changes the prediction most, but the delay is the first effect of the hypothesis."""
    prepared, trials = prepared_case(tmp_path, viscous=0.6, delay=0.002)
    problem = prepared.problem
    terms = (Term("command_delay", 0), Term("viscous_friction", 0))
    hypothesis = with_sizes(problem, terms, (0.002, 0.6))
    problem = problem.at(hypothesis)
    weights = 1.0 / problem.signal_floor
    fitted = fit(problem, [hypothesis], weights, problem.fit, iterations=12)[0]
    held = [problem.residuals([h], problem.held_out)[0] for h in (fitted.hypothesis, EMPTY)]
    best = ScoredModel(fitted, held[0], problem)
    bare = fit(problem, [EMPTY], weights, problem.fit, iterations=0)[0]
    nominal = ScoredModel(bare, held[1], problem)
    selected = SelectedModel(best, nominal, confidence=dict.fromkeys(terms, 1.0))
    found = build_explanation(
        prepared, selected, prune(prepared.problem, selected), trials
    ).findings
    assert [f.effect for f in found] == ["viscous_friction", "command_delay"]
    assert found[0].influence > 2.0 * found[1].influence > 0.0


@pytest.mark.parametrize(("slope", "absent"), [(1.0, True), (0.0, False)], ids=["gradient", "none"])
def test_an_effect_without_gradient_is_not_considered_absent(slope: float, absent: bool) -> None:
    """The finite difference of a time-out between two samples is zero."""
    term = Term("watchdog_timeout", 0)
    hypothesis = EMPTY.with_term(term, np.array([50.0, 0.05]))
    jacobian = np.ones((4, 1, 2)) * [slope, 1.0]
    fitted = FittedModel(hypothesis, np.zeros((4, 1)), jacobian, 0.0)
    known = ParameterUncertainty(np.array([1e6, 1e-3]), np.eye(2), np.eye(2), 2.0, np.eye(2))
    assert may_be_absent(fitted, term, known) is absent


@pytest.mark.parametrize(
    ("correlation_of_both", "absent"),
    [
        pytest.param(0.0, True, id="each alone may be zero"),
        pytest.param(-0.95, False, id="the sum is known and not zero"),
        pytest.param(0.95, True, id="the difference is known and zero"),
    ],
)
def test_correlated_parameters_are_tested_together_for_absence(
    correlation_of_both: float, absent: bool
) -> None:
    """Static and sliding friction are uncertain alone, but their sum may be certain."""
    term = Term("motor_load_friction", 0)
    hypothesis = EMPTY.with_term(term, np.array([0.1, 0.1, 0.5]))
    fitted = FittedModel(hypothesis, np.zeros((4, 1)), np.ones((4, 1, 3)), 0.0)
    correlation = np.eye(3)
    correlation[0, 1] = correlation[1, 0] = correlation_of_both
    known = ParameterUncertainty(
        np.array([0.12, 0.12, 1.0]), correlation, np.eye(3), 2.0, np.eye(3)
    )
    assert may_be_absent(fitted, term, known) is absent


def test_the_joint_confidence_region_contains_95_percent_of_normal_samples() -> None:
    """The samples are of a correlated normal distribution."""
    random = np.random.default_rng(3)
    correlation = np.array([[1.0, -0.8], [-0.8, 1.0]])
    known = ParameterUncertainty(np.full(2, 1.96), correlation, correlation, 1.96, correlation)
    draws = random.multivariate_normal(np.zeros(2), correlation, 2000)
    inside = np.mean([known.normalized_distance(np.arange(2), d) <= 1.0 for d in draws])
    assert inside == pytest.approx(0.95, abs=0.015)


def test_several_effects_at_a_joint_must_explain_more_than_a_single_one(tmp_path: Path) -> None:
    """A single effect may leave a tenth of the squared error, because others may be missing."""
    prepared, _ = prepared_case(tmp_path, viscous=0.3)
    before, term = np.array([400.0, 2.0]), Term("viscous_friction", 0)

    def left(after: float, *, several: bool) -> float:
        found = np.array([after, 2.0])
        return share_too_large(prepared.problem, term, before, found, several=several, sure=True)

    tenth = 400.0 * np.sqrt(0.1)
    assert left(tenth, several=False) == 0.0
    assert left(tenth, several=True) == pytest.approx(0.1, rel=0.01)
    # Two right effects may leave 2 %.
    assert left(400.0 * np.sqrt(0.02), several=True) == 0.0


@pytest.mark.parametrize(
    ("before", "is_kept"), [(400.0, False), (30.0, True)], ids=["400 floors", "30 floors"]
)
def test_an_effect_with_a_residual_of_many_noise_floors_must_explain_more(
    tmp_path: Path, before: float, *, is_kept: bool
) -> None:
    """A seventh of 400 squared floors is too much; a seventh of 30 may have other causes."""
    prepared, _ = prepared_case(tmp_path, viscous=0.3)
    levels = np.array([before, 2.0]), np.array([before * np.sqrt(1.0 / 7.0), 2.0])
    term = Term("viscous_friction", 0)
    share = share_too_large(prepared.problem, term, *levels, several=False, sure=True)
    assert (share == 0.0) is is_kept


@pytest.mark.parametrize(
    ("before", "after", "is_kept"),
    [
        pytest.param(2.5, 1.9, True, id="nominal error at the noise floor"),
        pytest.param(25.0, 19.0, False, id="nominal error far above the noise floor"),
    ],
)
def test_an_effect_is_not_rejected_on_recordings_with_a_small_nominal_error(
    tmp_path: Path, before: float, after: float, is_kept: bool
) -> None:
    """If the tested recordings hardly contain the error, the fit recordings decide."""
    prepared, _ = prepared_case(tmp_path, viscous=0.6)
    problem, term = prepared.problem, Term("viscous_friction", 0)
    found = selected_term(prepared, term, 0.5).best.fitted
    tested = refit_comparison(problem, found, *((level, 1.0) for level in (before, after, before)))
    assert bool(residual_remains(tested)) is not is_kept
    # What remains of a search whose time was over may be an effect that it did not come to.
    assert not residual_remains(replace(tested, not_simulated=frozenset({term})))


@pytest.mark.parametrize(
    ("lag", "is_kept"), [(0.001, False), (0.002, True)], ids=["4 floors", "8 floors"]
)
def test_a_very_small_effect_in_addition_to_a_large_one_is_rejected(
    tmp_path: Path, lag: float, is_kept: bool
) -> None:
    """Next to 700 floors of friction, 4 floors may be an error of the simulator; 8 are not."""
    prepared, _ = prepared_case(tmp_path, viscous=0.6, lag=lag)
    problem = prepared.problem
    terms = (Term("viscous_friction", 0), Term("actuator_lag", 0))
    hypothesis = with_sizes(problem, terms, (0.6, lag))
    problem = problem.at(hypothesis)
    best, bare = (
        ScoredModel(found, problem.residuals([found.hypothesis], problem.held_out)[0], problem)
        for found in (
            fit(problem, [h], 1.0 / problem.signal_floor, problem.fit, iterations=3)[0]
            for h in (hypothesis, EMPTY)
        )
    )
    selected = SelectedModel(best, bare, confidence=dict.fromkeys(terms, 1.0))
    pruned = prune(problem, selected)
    assert pruned.fitted.hypothesis.terms == (terms if is_kept else terms[:1])
    unneeded = "rejected: actuator_lag at left: it removes too little of the remaining error"
    assert pruned.notes == ([] if is_kept else [unneeded])


@pytest.mark.parametrize(
    ("own", "without", "is_kept"),
    [
        pytest.param(19.0, 21.0, True, id="whole error of its joint"),
        pytest.param(19.0, 4.0, True, id="error above the noise floor without it"),
        pytest.param(19.0, 2.5, False, id="small part of the error of its joint"),
        pytest.param(2.5, 2.5, False, id="whole error near the noise floor"),
    ],
)
def test_a_large_mismatch_at_one_joint_does_not_reject_an_effect_at_another(
    tmp_path: Path, own: float, without: float, is_kept: bool
) -> None:
    """20 floors at one joint are significant next to 900 floors at another, although rotor and link
    inertia explain them equally.
    """
    prepared, _ = prepared_case(tmp_path, viscous=0.6)
    problem, term = prepared.problem, Term("armature", 1)
    found = selected_term(prepared, term, 0.5, fitted=False).best.fitted
    floors = ((900.0, own), (1.0, 1.0), (1.0, without))
    tested = refit_comparison(problem, found, *floors, confidence={term: 0.5})
    assert bool(alternatives_more_likely(tested)) is not is_kept
    # Where the time did not suffice to simulate the alternatives, they reject nothing.
    assert not alternatives_more_likely(replace(tested, not_simulated=frozenset({term})))
