"""A wrong name is worse than none: what is taken back, and when a search ends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from two_pendulums import mjcf, record

from pytest_twin.commands.replay import load_model
from pytest_twin.diagnosis.findings import explain
from pytest_twin.diagnosis.fit import Fitted, fit
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.intervals import Spread
from pytest_twin.diagnosis.prepare import Prepared, prepare
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search import model_comparison
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.pruning import keep_named, prune
from pytest_twin.diagnosis.search.pruning_rules import (
    RefitComparison,
    at_bound_or_in_doubt,
    below_noise_floor,
    in_doubt,
    may_be_absent,
    negative_mean_friction,
    residual_remains,
    share_too_large,
    shift_within_time_step,
    small_and_replaceable,
    transmission_is_rigid,
    wrong_position_dependence,
)
from pytest_twin.diagnosis.search.scored_model import ScoredModel, SelectedModel
from pytest_twin.diagnosis.search.settings import ComparisonSettings
from pytest_twin.diagnosis.search.stepwise_selection import StepwiseSelection
from pytest_twin.formats.mcap import read_recording
from pytest_twin.trial import Trial, make_trial


def bench(folder: Path, **hidden: float) -> tuple[Prepared, list[Trial]]:
    """Two pendulums, one of which hides something; the second recording is held out."""
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


def chosen(prepared: Prepared, term: Term, start: float, *, fitted: bool = True) -> SelectedModel:
    """A search that came to one term."""
    problem = prepared.problem
    weights = 1.0 / problem.signal_floor

    def rival(hypothesis: Hypothesis, iterations: int) -> ScoredModel:
        found = fit(problem, [hypothesis], weights, problem.fit, iterations=iterations)[0]
        return ScoredModel(found, problem.residuals([found.hypothesis], problem.held_out)[0])

    best = rival(EMPTY.with_term(term, np.array([start])), 8 if fitted else 0)
    return SelectedModel(best, rival(EMPTY, 0), confidence={term: 1.0})


def of_floors(
    problem: Problem,
    fitted: Fitted,
    *floors: Sequence[float],
    confidence: Mapping[Term, float] | None = None,
) -> RefitComparison:
    """A fit of one term by the floors of each joint: as the model came, with it and without."""
    before, base, rest = (np.array(each) for each in floors)
    weights = 1.0 / problem.signal_floor
    return RefitComparison(
        problem, fitted, confidence or {}, before, base, [fitted], [rest], weights
    )


def of_one_term(problem: Problem, fitted: Fitted, left: float, without: float) -> RefitComparison:
    """A fit by the floors that the first joint keeps of a hundred, with its term and without."""
    return of_floors(problem, fitted, (100.0, 1.0), (left, 1.0), (without, 1.0))


def with_sizes(problem: Problem, terms: Sequence[Term], sizes: Sequence[float]) -> Hypothesis:
    """Laws of one free parameter at the first joint, SI units; choices as they are first tried."""
    found = EMPTY
    for term, size in zip(terms, sizes, strict=True):
        (parameter,) = (p for p in term.parameters if not p.choice)
        theta = [
            p.starts[0] if p.choice else size / problem.scales.value(parameter, 0)
            for p in term.parameters
        ]
        found = found.with_term(term, np.array(theta))
    return found


def test_a_law_at_its_physical_bound_that_leaves_much_is_no_name(tmp_path: Path) -> None:
    """Viscous friction, and dry friction as far as it can go, which takes three quarters of it."""
    prepared, trials = bench(tmp_path, viscous=0.6)
    term = Term("coulomb_friction", 0)
    selected = chosen(prepared, term, term.parameters[0].upper, fitted=False)
    found = explain(prepared, selected, prune(prepared.problem, selected), trials)
    assert not found.findings
    assert any("coulomb_friction at left" in n and "physical bound" in n for n in found.notes)


@pytest.mark.parametrize(("speed", "named"), [(0.1, True), (0.003, False), (3.0, False)])
def test_a_law_out_of_shape_that_does_not_explain_all_is_no_name(
    tmp_path: Path, speed: float, named: bool
) -> None:
    """Friction that falls over a speed at the end of its range stands for something else."""
    prepared, _ = bench(tmp_path, viscous=0.6)
    problem, term = prepared.problem, Term("stribeck_friction", 0)
    shaped = EMPTY.with_term(term, np.array([1.0, 0.5, speed]))
    assert not shaped.at_bound(term)
    weights = 1.0 / problem.signal_floor
    fitted = fit(problem, [shaped], weights, problem.fit, iterations=0, slopes=True)[0]

    def stretched(left: float) -> list[Term]:
        tested = of_one_term(problem, fitted, left, without=left)
        return [tested.terms[k] for k in at_bound_or_in_doubt(tested)]

    assert stretched(40.0) == ([] if named else [term])
    # Where it explains its joint it is as good a name as any.
    assert stretched(2.0) == []


@pytest.mark.parametrize(
    ("confidence", "rival", "named"),
    [(0.48, 0.5, True), (0.4, 0.6, True), (0.4, 0.3, True), (0.2, 0.7, False)],
)
def test_an_effect_that_shares_the_confidence_with_an_equal_one_is_no_closest_known(
    tmp_path: Path, confidence: float, rival: float, named: bool
) -> None:
    """A scale error and an eccentricity of one encoder are alike over a small angle."""
    prepared, _ = bench(tmp_path, viscous=0.6)
    problem, term = prepared.problem, Term("viscous_friction", 0)
    hypothesis = with_sizes(problem, [term], [0.6])
    weights = 1.0 / problem.signal_floor
    fitted = fit(problem, [hypothesis], weights, problem.fit, iterations=0, slopes=True)[0]
    tested = replace(
        of_floors(
            problem, fitted, (100.0, 1.0), (20.0, 1.0), (90.0, 1.0), confidence={term: confidence}
        ),
        rivals={term: rival},
    )
    gone = at_bound_or_in_doubt(tested)
    assert not gone if named else "other effects are more likely" in gone[0]


@pytest.mark.parametrize(
    ("distance", "without", "named"),
    [
        pytest.param(0.1, 2.0, True, id="bristles"),
        pytest.param(0.0, 2.0, False, id="dry friction in another form"),
        pytest.param(0.0, 4.0, True, id="far above the floor"),
    ],
)
def test_bristles_of_the_least_length_have_to_take_off_more(
    tmp_path: Path, distance: float, without: float, named: bool
) -> None:
    """All dry friction yields a little before it slides."""
    prepared, _ = bench(tmp_path, viscous=0.6)
    problem, term = prepared.problem, Term("presliding_hysteresis", 0)
    size, length = term.parameters
    start = EMPTY.with_term(term, np.array([size.starts[0], max(distance, length.lower)]))
    weights = 1.0 / problem.signal_floor
    (fitted,) = fit(problem, [start], weights, problem.fit, iterations=0, slopes=True)
    well_known = replace(fitted, jacobian=100.0 * fitted.jacobian)
    tested = of_one_term(problem, well_known, left=1.0, without=without)
    assert not may_be_absent(well_known, term, tested.known)
    gone = below_noise_floor(tested)
    assert list(gone) == ([] if named else [0])
    for note in gone.values():
        assert note == (
            "rejected: presliding_hysteresis at left: it reduces the residual by less than 3 times "
            "the noise floor"
        )


@pytest.mark.parametrize(("without", "named"), [(50.0, False), (70.0, True)])
def test_a_name_of_wide_interval_stays_where_much_more_is_left_without_it(
    tmp_path: Path, without: float, named: bool
) -> None:
    """A motion that hardly follows the law to first order, and refitted without it much is left."""
    prepared, _ = bench(tmp_path, viscous=0.6)
    problem, term = prepared.problem, Term("viscous_friction", 0)
    start = with_sizes(problem, (term,), (0.6,))
    weights = 1.0 / problem.signal_floor
    fitted = fit(problem, [start], weights, problem.fit, iterations=0, slopes=True)[0]
    flat = replace(fitted, jacobian=1e-6 * fitted.jacobian)
    assert in_doubt(of_one_term(problem, flat, 40.0, without), 0) is not named

    def stretched(fit_at_hand: Fitted, without: float) -> list[Term]:
        tested = of_one_term(problem, fit_at_hand, 40.0, without)
        return [tested.terms[k] for k in at_bound_or_in_doubt(tested)]

    assert stretched(flat, without) == ([] if named else [term])
    assert stretched(fitted, 40.0) == []


@pytest.mark.parametrize(
    ("effect", "size", "slope", "rigid"),
    [
        pytest.param("joint_elasticity", 0.01, 1e-6, True, id="its interval holds none"),
        pytest.param("joint_elasticity", 0.01, 1e4, False, id="it gives by so much"),
        pytest.param("viscous_friction", 0.6, 1e-6, False, id="no gear"),
    ],
)
def test_a_gear_as_good_as_rigid_is_no_name_whatever_it_takes_off(
    tmp_path: Path, effect: str, size: float, slope: float, rigid: bool
) -> None:
    prepared, _ = bench(tmp_path, viscous=0.6)
    problem, term = prepared.problem, Term(effect, 0)
    theta = [p.starts[0] if p.neutral is None else p.neutral for p in term.parameters]
    theta[term.switches(np.array(theta))[0]] = size
    weights = 1.0 / problem.signal_floor
    start = EMPTY.with_term(term, np.array(theta, dtype=float))
    (fitted,) = fit(problem, [start], weights, problem.fit, iterations=0, slopes=True)
    vague = replace(fitted, jacobian=slope * fitted.jacobian)
    gone = transmission_is_rigid(of_one_term(problem, vague, left=2.0, without=90.0))
    assert list(gone) == ([0] if rigid else [])
    for note in gone.values():
        assert note == (
            "rejected: joint_elasticity at left: its 95 % interval includes a rigid transmission"
        )


@pytest.mark.parametrize(
    ("hidden", "left", "named"),
    [
        pytest.param({"magnet": 0.3}, 30.0, False, id="another shape"),
        pytest.param({"magnet": 0.3}, 12.0, True, id="hardly anything is left"),
        pytest.param({"dry": 0.05}, 30.0, True, id="what is left goes with the velocity"),
    ],
)
def test_a_law_of_position_that_leaves_more_of_position_is_no_name(
    tmp_path: Path, hidden: dict[str, float], left: float, named: bool
) -> None:
    """A spring where a magnet pulls is stiff in one place and slack in another."""
    prepared, _ = bench(tmp_path, **hidden)
    problem, term = prepared.problem, Term("joint_spring", 0)
    weights = 1.0 / problem.signal_floor
    start = EMPTY.with_term(term, np.array([0.1, 0.0]))
    (fitted,) = fit(problem, [start], weights, problem.fit, iterations=8)
    gone = wrong_position_dependence(of_one_term(problem, fitted, left, without=left))
    assert list(gone) == ([] if named else [0])
    for note in gone.values():
        assert note.startswith("rejected: joint_spring at left, the closest known effect: ")
        assert "is still missing depends on the joint's position, so the true dependence" in note


def waving(problem: Problem, mean: float, *beside: tuple[Term, float]) -> Hypothesis:
    """Dry friction over the turn at the first joint, N m, 0.3 N m up and down."""
    wave = Term("position_dependent_friction", 0)
    sizes = {"mean": mean, "sine": 0.3, "cosine": 0.0, "harmonic": 8.0}
    scaled = [sizes[p.name] / problem.scales.value(p, 0) for p in wave.parameters]
    terms, values = ([t for t, _ in beside], [v for _, v in beside])
    return with_sizes(problem, terms, values).with_term(wave, np.array(scaled))


def test_less_than_no_friction_over_the_turn_is_no_name(tmp_path: Path) -> None:
    """Cut off at zero it brakes in one place, as a patch of dirt does."""
    problem = bench(tmp_path, dry=0.05)[0].problem
    weights = 1.0 / problem.signal_floor

    def taken_back(hypothesis: Hypothesis) -> dict[int, str]:
        (fitted,) = fit(problem, [hypothesis], weights, problem.fit, iterations=0)
        tested = of_one_term(problem, fitted, 2.0, without=50.0)
        return dict(negative_mean_friction(tested))

    (note,) = taken_back(waving(problem, -0.1)).values()
    assert note.startswith(
        "rejected: position_dependent_friction at left, the closest known effect: "
    )
    assert "the mean dry friction of the joint would be negative" in note
    # A bent shaft may run free for a part of the turn, and what is dry beside it counts.
    assert not taken_back(waving(problem, 0.1))
    assert not taken_back(waving(problem, -0.1, (Term("coulomb_friction", 0), 0.2)))
    # What is dry beside it there goes with it.
    there, elsewhere, viscous = (
        Term("coulomb_friction", 0), Term("coulomb_friction", 1), Term("viscous_friction", 0)
    )  # fmt: skip
    assert list(taken_back(waving(problem, -0.1, (there, 0.05)))) == [0, 1]
    assert list(taken_back(waving(problem, -0.1, (elsewhere, 0.2)))) == [1]
    assert list(taken_back(waving(problem, -0.1, (viscous, 0.2)))) == [1]
    own = problem.simulator.segments[0].model.dof_frictionloss
    own[0] = 0.2
    assert not taken_back(waving(problem, -0.1))


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
def test_a_special_case_is_not_out_of_shape(effect: str, shape: float, is_out: bool) -> None:
    """What is in the loop or not, and teeth that are rigid; a tool four reaches away is odd."""
    term = Term(effect, 0)
    theta = np.zeros(len(term.parameters))
    theta[:2] = 0.01, shape
    assert EMPTY.with_term(term, theta).out_of_shape(term) is is_out


def test_a_push_may_begin_and_end_with_the_trial() -> None:
    push = Term("external_force", 0)
    assert not EMPTY.with_term(push, np.array([0.5, 0.0, 12.0])).out_of_shape(push)


def test_names_that_were_judged_elsewhere_stay(tmp_path: Path) -> None:
    """The same law, though it leaves much: what windows named is not judged once more."""
    prepared, trials = bench(tmp_path, viscous=0.6)
    term = Term("coulomb_friction", 0)
    selected = chosen(prepared, term, 0.1)
    assert not prune(prepared.problem, selected).fitted.hypothesis.terms
    pruned = keep_named(ModelComparison(prepared.problem), selected.best)
    assert [h.terms for h in pruned.reduced_models] == [()]
    (found,) = explain(prepared, selected, pruned, trials).findings
    assert (found.effect, found.joint) == ("coulomb_friction", "left")


def test_a_name_that_takes_nothing_off_over_whole_motions_goes(tmp_path: Path) -> None:
    prepared, _ = bench(tmp_path, viscous=0.3)
    problem = prepared.problem
    right, idle = Term("viscous_friction", 0), Term("quadratic_drag", 1)
    start = EMPTY.with_term(right, np.array([0.1])).with_term(idle, np.array([1e-3]))
    judges = ModelComparison(problem)
    (best,) = judges.rivals([start], 1.0 / problem.signal_floor, 8, slopes=True)
    pruned = keep_named(judges, best)
    assert pruned.fitted.hypothesis.terms == (right,)
    assert [h.terms for h in pruned.reduced_models] == [()]
    assert pruned.fitted.jacobian.shape[-1] == 1
    assert pruned.notes == [
        "rejected: quadratic_drag at right: it reduces the error over whole recordings too little"
    ]


def test_a_law_that_explains_all_stays(tmp_path: Path) -> None:
    prepared, trials = bench(tmp_path, viscous=0.3)
    selected = chosen(prepared, Term("viscous_friction", 0), 0.1)
    found = explain(prepared, selected, prune(prepared.problem, selected), trials)
    assert [(f.effect, f.joint) for f in found.findings] == [("viscous_friction", "left")]


@pytest.mark.parametrize(
    ("effect", "joint", "size", "named"),
    [
        ("clock_drift", -1, 1.5e-4, False),
        ("clock_drift", -1, -1.5e-4, False),
        ("clock_drift", -1, 2e-3, True),
        ("sensor_delay", -1, 1e-4, False),
        ("command_delay", 0, 1e-4, False),
        ("command_delay", 0, 1e-3, True),
        ("viscous_friction", 0, 1e-4, True),
    ],
)
def test_a_shift_of_a_small_part_of_a_step_is_no_name(
    tmp_path: Path, effect: str, joint: int, size: float, named: bool
) -> None:
    """However much it takes off; a tenth of a millisecond, in steps of one or two."""
    prepared, _ = bench(tmp_path, viscous=0.6)
    problem, term = prepared.problem, Term(effect, joint)
    hypothesis = with_sizes(problem, [term], [size])
    weights = 1.0 / problem.signal_floor
    fitted = fit(problem, [hypothesis], weights, problem.fit, iterations=0, slopes=True)[0]
    gone = shift_within_time_step(of_one_term(problem, fitted, 1.0, without=50.0))
    assert not gone if named else "small part of the time step" in gone[0]


def test_what_predicted_nothing_unseen_has_to_take_off_more(tmp_path: Path) -> None:
    prepared, _ = bench(tmp_path, viscous=0.003)
    problem = prepared.problem
    selected = chosen(prepared, Term("viscous_friction", 0), 0.01)
    assert prune(problem, selected).fitted.hypothesis.terms
    problem.held_out = problem.held_out[:0]
    pruned = prune(problem, selected)
    assert not pruned.fitted.hypothesis.terms
    assert pruned.notes == [
        "rejected: viscous_friction at left: it reduces the residual by less than 3 times the "
        "noise floor"
    ]


def test_a_search_ends_when_its_replays_are_spent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared, _ = bench(tmp_path, delay=0.02)
    monkeypatch.setattr(model_comparison, "COMPARISON", ComparisonSettings(simulations=0))
    stepped = prepared.problem.stepped
    selected = StepwiseSelection(prepared.problem).run()
    assert not selected.best.hypothesis.terms
    assert prepared.problem.stepped - stepped < 10 * prepared.problem.simulator.steps.sum()


def test_names_at_other_joints_have_replays_of_their_own(tmp_path: Path) -> None:
    prepared, _ = bench(tmp_path, delay=0.02)
    problem = prepared.problem
    here = model_comparison.ModelComparison(problem)
    names = ("viscous_friction", "coulomb_friction", "armature", "joint_spring", "effort_bias")
    crowd = [Term(name, 0) for name in names]
    apart = [*crowd[:3], Term("viscous_friction", 1)]
    once = int(problem.simulator.steps.sum())
    problem.simulator.stepped += 475 * once
    assert here.is_spent([])
    assert here.is_spent(crowd), "a crowd at one joint counts as three"
    assert not here.is_spent(apart)
    problem.simulator.stepped += 50 * once
    assert here.is_spent(apart)


def test_what_moves_the_prediction_most_without_it_comes_first(tmp_path: Path) -> None:
    """Much friction on one pendulum, a short delay on the other, named the other way round."""
    prepared, trials = bench(tmp_path, viscous=0.6, delay=0.002)
    problem = prepared.problem
    terms = (Term("command_delay", 0), Term("viscous_friction", 0))
    hypothesis = with_sizes(problem, terms, (0.002, 0.6))
    problem.refine_at(hypothesis)
    weights = 1.0 / problem.signal_floor
    fitted = fit(problem, [hypothesis], weights, problem.fit, iterations=12)[0]
    best = ScoredModel(fitted, problem.residuals([fitted.hypothesis], problem.held_out)[0])
    bare = fit(problem, [EMPTY], weights, problem.fit, iterations=0)[0]
    nominal = ScoredModel(bare, problem.residuals([EMPTY], problem.held_out)[0])
    selected = SelectedModel(best, nominal, confidence=dict.fromkeys(terms, 1.0))
    found = explain(prepared, selected, prune(prepared.problem, selected), trials).findings
    assert [f.effect for f in found] == ["viscous_friction", "command_delay"]
    assert found[0].influence > 2.0 * found[1].influence > 0.0


@pytest.mark.parametrize(("slope", "absent"), [(1.0, True), (0.0, False)])
def test_what_acts_in_leaps_has_no_interval_and_is_there(slope: float, absent: bool) -> None:
    """A time-out between two samples: a finite difference of it moves nothing."""
    term = Term("watchdog_timeout", 0)
    hypothesis = EMPTY.with_term(term, np.array([50.0, 0.05]))
    jacobian = np.ones((4, 1, 2)) * [slope, 1.0]
    fitted = Fitted(hypothesis, np.zeros((4, 1)), jacobian, 0.0)
    known = Spread(np.array([1e6, 1e-3]), np.eye(2), np.eye(2), 2.0, np.eye(2))
    assert may_be_absent(fitted, term, known) is absent


@pytest.mark.parametrize(
    ("together", "absent"),
    [
        pytest.param(0.0, True, id="each alone could be absent"),
        pytest.param(-0.95, False, id="their sum is known, and is not zero"),
        pytest.param(0.95, True, id="their difference is known, and is zero"),
    ],
)
def test_what_trades_off_is_judged_together(together: float, absent: bool) -> None:
    """Friction at rest and in motion: how much of which is open, and that there is some is not."""
    term = Term("motor_load_friction", 0)
    hypothesis = EMPTY.with_term(term, np.array([0.1, 0.1, 0.5]))
    fitted = Fitted(hypothesis, np.zeros((4, 1)), np.ones((4, 1, 3)), 0.0)
    correlation = np.eye(3)
    correlation[0, 1] = correlation[1, 0] = together
    known = Spread(np.array([0.12, 0.12, 1.0]), correlation, np.eye(3), 2.0, np.eye(3))
    assert may_be_absent(fitted, term, known) is absent


def test_the_joint_region_holds_what_normal_draws_say() -> None:
    """95 % of draws from a correlated normal distribution lie inside of it."""
    random = np.random.default_rng(3)
    correlation = np.array([[1.0, -0.8], [-0.8, 1.0]])
    known = Spread(np.full(2, 1.96), correlation, correlation, 1.96, correlation)
    draws = random.multivariate_normal(np.zeros(2), correlation, 2000)
    inside = np.mean([known.apart(np.arange(2), d) <= 1.0 for d in draws])
    assert inside == pytest.approx(0.95, abs=0.015)


def test_several_names_at_a_joint_have_to_explain_more(tmp_path: Path) -> None:
    """Alone a name may leave a tenth: others may be missing. Two that leave much are two wrong."""
    prepared, _ = bench(tmp_path, viscous=0.3)
    before, term = np.array([400.0, 2.0]), Term("viscous_friction", 0)

    def left(after: float, *, several: bool) -> float:
        found = np.array([after, 2.0])
        return share_too_large(prepared.problem, term, before, found, several=several, sure=True)

    tenth = 400.0 * np.sqrt(0.1)
    assert left(tenth, several=False) == 0.0
    assert left(tenth, several=True) == pytest.approx(0.1, rel=0.01)
    # A fiftieth is what two right ones may leave of so much.
    assert left(400.0 * np.sqrt(0.02), several=True) == 0.0


@pytest.mark.parametrize(("before", "stays"), [(400.0, False), (30.0, True)])
def test_a_name_that_leaves_many_floors_has_to_explain_more(
    tmp_path: Path, before: float, *, stays: bool
) -> None:
    """A seventh of 400 floors is no law's error; of thirty, others that are missing may be it."""
    prepared, _ = bench(tmp_path, viscous=0.3)
    levels = np.array([before, 2.0]), np.array([before * np.sqrt(1.0 / 7.0), 2.0])
    term = Term("viscous_friction", 0)
    share = share_too_large(prepared.problem, term, *levels, several=False, sure=True)
    assert (share == 0.0) is stays


@pytest.mark.parametrize(
    ("before", "after", "stays"),
    [
        pytest.param(2.5, 1.9, True, id="at the floor with the model as it came"),
        pytest.param(25.0, 19.0, False, id="far above it"),
    ],
)
def test_recordings_that_hardly_show_it_do_not_judge_it(
    tmp_path: Path, before: float, after: float, stays: bool
) -> None:
    """A tip that touches a table once where nothing is fitted: what was fitted tells, then."""
    prepared, _ = bench(tmp_path, viscous=0.6)
    problem, term = prepared.problem, Term("viscous_friction", 0)
    found = chosen(prepared, term, 0.5).best.fitted
    tested = of_floors(problem, found, *((level, 1.0) for level in (before, after, before)))
    assert bool(residual_remains(tested)) is not stays


@pytest.mark.parametrize(("lag", "stays"), [(0.001, False), (0.002, True)])
def test_a_slight_name_beside_a_strong_one_is_none(tmp_path: Path, lag: float, stays: bool) -> None:
    """Beside seven hundred floors of friction four may be the simulator's own; eight are not."""
    prepared, _ = bench(tmp_path, viscous=0.6, lag=lag)
    problem = prepared.problem
    terms = (Term("viscous_friction", 0), Term("actuator_lag", 0))
    hypothesis = with_sizes(problem, terms, (0.6, lag))
    problem.refine_at(hypothesis)
    best, bare = (
        ScoredModel(found, problem.residuals([found.hypothesis], problem.held_out)[0])
        for found in (
            fit(problem, [h], 1.0 / problem.signal_floor, problem.fit, iterations=3)[0]
            for h in (hypothesis, EMPTY)
        )
    )
    selected = SelectedModel(best, bare, confidence=dict.fromkeys(terms, 1.0))
    pruned = prune(problem, selected)
    assert pruned.fitted.hypothesis.terms == (terms if stays else terms[:1])
    idle = "rejected: actuator_lag at left: it removes too little of the remaining error"
    assert pruned.notes == ([] if stays else [idle])


@pytest.mark.parametrize(
    ("own", "without", "stays"),
    [
        pytest.param(19.0, 21.0, True, id="all that its own joint has to explain"),
        pytest.param(19.0, 4.0, False, id="little of it"),
        pytest.param(2.5, 2.5, False, id="all of next to nothing"),
    ],
)
def test_a_small_mismatch_at_one_joint_is_not_slight_for_a_large_one_at_another(
    tmp_path: Path, own: float, without: float, stays: bool
) -> None:
    """Twenty floors of one arm's inertia beside nine hundred of the other's drive are no chance,
    though a link's inertia would say the same as a rotor's.
    """
    prepared, _ = bench(tmp_path, viscous=0.6)
    problem, term = prepared.problem, Term("armature", 1)
    found = chosen(prepared, term, 0.5, fitted=False).best.fitted
    floors = ((900.0, own), (1.0, 1.0), (1.0, without))
    tested = of_floors(problem, found, *floors, confidence={term: 0.5})
    assert bool(small_and_replaceable(tested)) is not stays
