"""What could stand in the place of what was named, of one name or of several."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_elastic_transmissions import scored_model, single_effect
from test_first_order import ELBOW, ROBOT, SHOULDER, carried, problem_of

from pytest_twin.diagnosis.first_order.sensitivities import grid
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search.linearized_view import linearize_around
from pytest_twin.diagnosis.search.model_comparison import FAIR, ModelComparison
from pytest_twin.diagnosis.search.scored_model import (
    ScoredModel,
    SelectedModel,
    compare_below_floor,
)
from pytest_twin.diagnosis.search.simplification import simpler_forms
from pytest_twin.diagnosis.search.stepwise_selection import StepwiseSelection, have_same_forms
from pytest_twin.diagnosis.search.term_exchange import (
    TermExchange,
    better_as_addition,
    better_than_several,
    chance_gain,
    find_exchanges,
    simulated_evidence,
)

MASS, BODY = Term("payload", ROBOT), Term("inertial_parameters", ELBOW)
SPRING, REFLECTED = Term("joint_spring", ELBOW), Term("armature", ELBOW)
DRAG, DRY = Term("viscous_friction", ELBOW), Term("coulomb_friction", ELBOW)
ON_IT = (MASS, BODY)
"""What a load may be, to first order: a last link of other mass and centre has it in it."""
CARRIED = carried(0.3, 0.2)
BRAKED = {DRAG: {"coefficient": 0.2}, DRY: {"coulomb": 0.3}}


@pytest.fixture(scope="module")
def loaded() -> Problem:
    return problem_of("position", {MASS: CARRIED})


def settled(comparison: ModelComparison, *terms: Term) -> ScoredModel:
    """Terms, each at its first starting size, fitted to the end."""
    start = EMPTY
    for t in terms:
        start = start.with_term(t, grid(t)[0][0])
    return comparison.fit_to_convergence(
        comparison.rivals([start], comparison.weights(comparison.nominal), FAIR)[0]
    )


def around(problem: Problem, comparison: ModelComparison, best: ScoredModel) -> list[TermExchange]:
    before = linearize_around(problem, comparison.nominal)
    known = {
        t: [r for r in before.candidate_sensitivities.responses if r.term == t]
        for t in before.evaluated
    }
    return find_exchanges(
        problem, best, linearize_around(problem, best), known, comparison.penalty_per_effect
    )


def as_load(problem: Problem, exchange: TermExchange) -> Hypothesis:
    """The load that stands there, or that the last link there carries."""
    there = exchange.hypothesis
    return next(h for h in (there, *simpler_forms(problem, there)) if h.terms == (MASS,))


def test_two_that_hold_each_other_up_give_way_to_the_one_in_their_place(loaded: Problem) -> None:
    comparison = ModelComparison(loaded)
    best = settled(comparison, SPRING, REFLECTED)
    found = [x for x in around(loaded, comparison, best) if x.new in ON_IT and len(x.removed) == 2]
    (one,) = found
    assert one.removed == (SPRING, REFLECTED)
    assert one.evidence > 0.0
    assert one.hypothesis.terms == (one.new,)
    true = single_effect(loaded, MASS, CARRIED)
    assert np.prod(as_load(loaded, one).theta[:2]) == pytest.approx(
        np.prod(true.theta[:2]), rel=0.1
    )


def test_a_term_that_stands_among_the_wrong_ones_starts_anew_in_their_place(
    loaded: Problem,
) -> None:
    """A payload that takes off what a heavier link has too much, in the place of both."""
    comparison = ModelComparison(loaded)
    wrong = single_effect(loaded, MASS, carried(-0.05, 0.05))
    (best,) = comparison.rivals(
        [wrong.with_term(BODY, np.array([0.6, 0.0, 0.0, 0.0, 0.0, 0.0]))],
        comparison.weights(comparison.nominal), 0, slopes=True,
    )  # fmt: skip
    (one,) = [
        x for x in around(loaded, comparison, best)
        if x.new in ON_IT and set(x.removed) == {MASS, BODY}
    ]  # fmt: skip
    assert one.hypothesis.terms == (one.new,)
    assert as_load(loaded, one).theta[0] > 0.0
    assert one.evidence > 0.0


def test_what_a_name_does_alone_is_lost_without_it() -> None:
    problem = problem_of("position", BRAKED)
    comparison = ModelComparison(problem)
    both = single_effect(problem, DRAG, BRAKED[DRAG]).with_term(
        DRY, single_effect(problem, DRY, BRAKED[DRY]).theta
    )
    found = around(problem, comparison, scored_model(comparison, both))
    bare = {x.removed: x.evidence for x in found if x.new is None}
    assert bare.keys() == {(DRAG,), (DRY,)}
    assert max(bare.values()) < -30.0
    # Nothing is offered that stands beside it already.
    assert not any(x.new in both.without(*x.removed).terms for x in found)


def test_a_rival_of_another_motion_is_judged_with_its_own_step(
    loaded: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    selection = StepwiseSelection(loaded)
    best = scored_model(selection.comparison, EMPTY)
    # What the step costs differs between the two: the rival is worth what it is at its own.
    rival = scored_model(selection.comparison, single_effect(loaded, MASS, CARRIED))
    at: list[Hypothesis] = []
    monkeypatch.setattr(Problem, "refine_at", lambda self, h: at.append(h))
    for evidence in (-3.0, -1e5, 10.0):
        rival.evidence = evidence
        assert selection.judge_with_own_correction(rival, best) is rival
    assert at == []
    rival.evidence = -400.0
    assert selection.judge_with_own_correction(rival, best).evidence > 0.0
    # Nothing of that stays for the others.
    assert at == [rival.hypothesis, best.hypothesis]


def test_what_is_better_in_a_place_may_be_better_still_beside_it() -> None:
    problem = problem_of("position", BRAKED)
    selection = StepwiseSelection(problem)
    comparison = selection.comparison
    best, top = settled(comparison, DRAG), settled(comparison, DRY)
    comparison.judge([top], best)
    assert set(selection.kept_in_addition(best, top).hypothesis.terms) == {DRAG, DRY}
    # A law that has the other in it is all that is needed.
    other = problem_of("position", {DRY: BRAKED[DRY]})
    selection = StepwiseSelection(other)
    comparison = selection.comparison
    best, top = settled(comparison, DRAG), settled(comparison, DRY)
    comparison.judge([top], best)
    assert selection.kept_in_addition(best, top) is top


def test_an_exchange_comes_from_two_wrong_names_to_the_right_one(loaded: Problem) -> None:
    selection = StepwiseSelection(loaded)
    comparison = selection.comparison
    selection.known_sensitivities = {
        MASS: [
            r
            for r in linearize_around(loaded, comparison.nominal).candidate_sensitivities.responses
            if r.term == MASS
        ]
    }  # fmt: skip
    selected = SelectedModel(settled(comparison, SPRING, REFLECTED), comparison.nominal)
    assert selection.exchange_terms(selected)
    assert selected.best.hypothesis.terms == (MASS,)
    true = single_effect(loaded, MASS, CARRIED)
    moment, its = (np.prod(h.theta[:2]) for h in (selected.best.hypothesis, true))
    assert moment == pytest.approx(its, rel=0.1)


def test_what_explains_something_else_is_a_rival_of_nothing() -> None:
    """A little drag at the elbow, which was named, and more dry friction at the shoulder."""
    rubs = Term("coulomb_friction", SHOULDER)
    problem = problem_of("position", {DRAG: BRAKED[DRAG], rubs: {"coulomb": 1.0}})
    selection = StepwiseSelection(problem)
    best = settled(selection.comparison, DRAG)
    look = linearize_around(problem, best)
    found = around(problem, selection.comparison, best)
    price = selection.comparison.penalty_per_effect
    beside = better_as_addition(best, look, found, 30.0, price)
    hypothesis, evidence = beside[rubs]
    assert set(hypothesis.terms) == {DRAG, rubs}
    assert hypothesis.theta[hypothesis.slice_of(rubs)] > 0.0
    (instead,) = [x for x in found if x.removed == (DRAG,) and x.new == rubs]
    assert evidence > instead.evidence > 30.0, "better in the drag's place, and better beside it"
    assert not better_as_addition(best, look, found, evidence + 1.0, price), (
        "nothing is clearly better"
    )

    selected = SelectedModel(best, selection.comparison.nominal)
    assert selection.exchange_terms(selected)
    assert set(selected.best.hypothesis.terms) == {DRAG, rubs}
    assert selected.confidence[DRAG] > 0.99
    assert all(
        rival.joint != SHOULDER for rival, share in selected.alternatives[DRAG] if share > 0.01
    )


def test_what_is_better_beside_everything_is_tried_in_the_place_of_several() -> None:
    """A drive whose effort falls with speed, as a limit and drag: in the place of both its shape is
    what it came to beside them.
    """
    falls = Term("torque_speed_limit", ELBOW)
    hidden = {"inverse_no_load_speed": 1.0 / 1.5, "stall": 2.5}
    problem = problem_of("position", {falls: hidden})
    comparison = ModelComparison(problem)
    limit, drag = Term("torque_saturation", ELBOW), Term("quadratic_drag", ELBOW)
    best = settled(comparison, limit, drag)
    look, price = linearize_around(problem, best), comparison.penalty_per_effect
    true = single_effect(problem, falls, hidden)
    both = best.hypothesis.with_term_of(true, falls)
    old = TermExchange((limit, drag), falls, EMPTY, -85.0, False)
    elsewhere = TermExchange((limit,), DRY, EMPTY, -4.0, False)

    offered = better_than_several(best, look, [old, elsewhere], {falls: (both, 50.0)}, price)
    assert offered[0] is elsewhere
    (one,) = offered[1:]
    assert (one.removed, one.new) == ((limit, drag), falls)
    assert one.evidence > 30.0
    assert one.hypothesis.terms == (falls,)
    assert one.hypothesis.theta == pytest.approx(true.theta, rel=0.05)
    # Nothing is clearly better, or not at a joint with several names: all stays as it was.
    assert better_than_several(best, look, [old], {}, price) == [old]
    brake = Term("coulomb_friction", SHOULDER)
    at_shoulder = best.hypothesis.with_term(brake, np.array([0.1]))
    assert better_than_several(best, look, [old], {brake: (at_shoulder, 50.0)}, price) == [old]


@pytest.mark.parametrize(
    ("floors", "here", "anew"),
    [(2.0, False, False), (5.0, False, True), (5.0, True, False), (20.0, False, False)],
)
def test_what_leaves_a_little_is_looked_at_where_it_is(
    loaded: Problem, floors: float, here: bool, anew: bool
) -> None:
    """Laws that bend answer a fit elsewhere otherwise; of what is far off that is no matter."""
    selection = StepwiseSelection(loaded)
    nominal = selection.comparison.nominal
    left = np.ones_like(nominal.fitted.residual) * floors * loaded.signal_floor
    best = replace(nominal, fitted=replace(nominal.fitted, residual=left))
    selection.last_linearization = replace(
        linearize_around(loaded, nominal), around=best if here else nominal
    )
    assert (selection._known_around(best) is None) is anew


def test_what_is_right_in_a_place_is_a_rival_though_it_is_better_beside_it_too() -> None:
    problem = problem_of("position", {DRY: BRAKED[DRY]})
    selection = StepwiseSelection(problem)
    best = settled(selection.comparison, DRAG)
    found = around(problem, selection.comparison, best)
    beside = better_as_addition(
        best, linearize_around(problem, best), found, 30.0, selection.comparison.penalty_per_effect
    )
    (instead,) = [x for x in found if x.removed == (DRAG,) and x.new == DRY]
    assert 30.0 < beside[DRY][1] < instead.evidence, "the name that is not needed has its price"
    selected = SelectedModel(best, selection.comparison.nominal)
    assert selection.exchange_terms(selected)
    assert selected.confidence[DRAG] < 1e-3
    # Another law of dry friction may be exchanged first.
    selection.exchange_terms(selected)
    assert selected.best.hypothesis.terms == (DRY,)


def test_two_that_are_each_taken_for_the_other_are_as_likely(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is better in a place, and is turned back to what stood there, is neither more nor less:
    the search ends there.
    """
    problem = problem_of("position", {DRAG: BRAKED[DRAG]})
    run = Run()
    selection = StepwiseSelection(problem, run)
    drag = Term("quadratic_drag", DRAG.joint)
    best = settled(selection.comparison, drag)
    selected = SelectedModel(best, selection.comparison.nominal)
    monkeypatch.setattr(StepwiseSelection, "eliminate", lambda self, rival: best)
    assert not selection.exchange_terms(selected)
    assert selected.best is best
    shares = {t.effect: share for t, share in selected.alternatives[drag]}
    last = run.trace.steps[-1]
    assert (last.move, last.decision) == ("exchange", "accepted")
    (better,) = [e for e in shares if any(name.startswith(f"{e} at ") for name in last.proposed)]
    assert shares[better] == pytest.approx(selected.confidence[drag], rel=1e-9)
    # Another form of the same law is not the same.
    of_rate, of_effort = (
        Hypothesis((Term("rate_limit", SHOULDER),), np.array([1.0, 1.0, choice]))
        for choice in (0.0, 1.0)
    )
    assert have_same_forms(of_rate, of_rate.with_theta(0.5 * of_rate.theta))
    assert not have_same_forms(of_rate, of_effort)


def test_what_was_simulated_without_a_name_counts_in_its_place() -> None:
    problem = problem_of("position", {DRAG: BRAKED[DRAG]})
    selection = StepwiseSelection(problem)
    selected = SelectedModel(settled(selection.comparison, DRAG), selection.comparison.nominal)
    assert not selection.exchange_terms(selected)
    assert selected.confidence[DRAG] > 0.9
    selection.simulated_losses = {(): 20.0}
    selection.exchange_terms(selected)
    assert selected.confidence[DRAG] < 1e-3
    # Where it was not simulated, or is not what was, the measured motion has its say.
    selection.simulated_losses = {(SPRING,): 20.0}
    selection.exchange_terms(selected)
    assert selected.confidence[DRAG] > 0.9


def test_a_law_that_has_another_in_it_is_no_rival_of_it() -> None:
    problem = problem_of("position", {DRY: BRAKED[DRY]})
    selection = StepwiseSelection(problem)
    comparison = selection.comparison
    best = settled(comparison, DRY)
    offered = [x.new for x in around(problem, comparison, best) if x.removed == (DRY,) and x.new]
    assert any(DRY.effect in new.law.generalizes for new in offered)
    selected = SelectedModel(best, comparison.nominal)
    assert not selection.exchange_terms(selected)
    assert selected.alternatives[DRY]
    assert not any(DRY.effect in new.law.generalizes for new, _ in selected.alternatives[DRY])


def test_rivals_that_hardly_lose_are_simulated(
    loaded: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    selection = StepwiseSelection(loaded)
    comparison = selection.comparison
    best = scored_model(comparison, single_effect(loaded, MASS, CARRIED))
    monkeypatch.setattr(comparison, "rivals", lambda starts, *rest: [best] * len(starts))
    removed = (MASS,)

    def simulated(lost: float, behind: float) -> list[Term | None]:
        found = [
            TermExchange(removed, None, EMPTY, lost, False),
            TermExchange(removed, DRAG, single_effect(loaded, DRAG, BRAKED[DRAG]), behind, False),
        ]
        return [x.new for x, _ in selection.simulated_exchanges(best, found, ())]

    assert simulated(lost=-500.0, behind=-20.0) == [DRAG]
    assert simulated(lost=-500.0, behind=-40.0) == []
    assert simulated(lost=-5000.0, behind=-200.0) == [DRAG]
    assert simulated(lost=-5000.0, behind=-300.0) == []

    # In the place of several what is lost without the one that does most counts.
    several = [
        TermExchange((MASS,), None, EMPTY, -5000.0, False),
        TermExchange((DRY,), None, EMPTY, -3.0, False),
        TermExchange((MASS, DRY), DRAG, single_effect(loaded, DRAG, BRAKED[DRAG]), -200.0, False),
    ]
    assert [x.new for x, _ in selection.simulated_exchanges(best, several, ())] == [DRAG]
    assert selection.simulated_exchanges(best, several[1:], ()) == []


def at_starts(*terms: Term) -> Hypothesis:
    return EMPTY.with_terms({t: grid(t)[0][0] for t in terms})


def by_chance_of(
    removed: tuple[Term, ...], new: Term | None, lost: float, unseen: float = 1.0
) -> float:
    bare = TermExchange(removed, None, EMPTY, -lost, False)
    there = at_starts(new) if new else EMPTY
    other = TermExchange(removed, new, there, 7.0, False)
    return chance_gain(at_starts(*removed), [bare, other], unseen)[removed, new]


def test_more_parameters_are_ahead_by_chance() -> None:
    assert by_chance_of((BODY,), MASS, lost=500.0) == pytest.approx(5.0)
    assert by_chance_of((BODY,), MASS, lost=1e5) == pytest.approx(15.0)
    # Where nothing is lost nothing is allowed, nor with as many parameters.
    assert by_chance_of((BODY,), MASS, lost=-3.0) == 0.0
    assert by_chance_of((DRAG,), DRY, lost=1e5) == 0.0
    assert by_chance_of((DRAG, DRY), MASS, lost=1e5) == 0.0
    assert by_chance_of((MASS, DRY), DRAG, lost=1e5) == 0.0
    assert by_chance_of((DRAG,), None, lost=1e5) == 0.0


def test_fewer_parameters_may_be_behind_by_chance() -> None:
    assert by_chance_of((MASS,), DRAG, lost=500.0) == pytest.approx(-5.0)
    assert by_chance_of((MASS,), DRAG, lost=1e5) == pytest.approx(-15.0)
    assert by_chance_of((MASS,), DRAG, lost=-3.0) == 0.0


def test_what_was_not_simulated_loses_what_those_that_seemed_nearer_lost() -> None:
    """Otherwise what seems good along the motion would be likelier than what was simulated."""
    bare, drag, dry, mass, gear, elsewhere = found = [
        TermExchange((BODY,), None, EMPTY, -2000.0, False),
        TermExchange((BODY,), DRAG, EMPTY, 41.0, False),
        TermExchange((BODY,), DRY, EMPTY, 29.0, False),
        TermExchange((BODY,), MASS, EMPTY, 27.0, False),
        TermExchange((BODY,), Term("backlash", ELBOW), EMPTY, 500.0, True),
        TermExchange((DRAG,), MASS, EMPTY, 12.0, False),
    ]
    evidence = simulated_evidence(found, [(drag, -60.0), (dry, -3600.0)])
    assert [evidence[x.removed, x.new] for x in (drag, dry, mass)] == [-60.0, -3600.0, 27.0 - 101.0]
    # Nothing in their place was to be simulated, along the motion a gear is not told, and another
    # place says nothing of this one.
    assert [evidence[x.removed, x.new] for x in (bare, gear, elsewhere)] == [-2000.0, 500.0, 12.0]
    # What simulation finds better than it seemed says nothing of the others.
    assert simulated_evidence(found, [(drag, 90.0)])[mass.removed, mass.new] == 27.0


def test_a_law_that_has_another_in_it_is_clearly_ahead_or_gives_way() -> None:
    """A softer drive that only damps is a brake; friction that hardly varies is dry friction."""
    gain, turning = Term("controller_gain", ELBOW), Term("position_dependent_friction", ELBOW)
    assert by_chance_of((DRAG,), gain, lost=1e4) == pytest.approx(200.0)
    assert by_chance_of((DRY,), turning, lost=1e4) == pytest.approx(200.0)
    assert by_chance_of((turning,), DRY, lost=1e4) == pytest.approx(-100.0)
    # In as much again that no fit has seen it does as much again that is not quite so.
    assert by_chance_of((DRAG,), gain, lost=1e4, unseen=2.0) == pytest.approx(400.0)
    assert by_chance_of((turning,), DRY, lost=1e4, unseen=2.0) == pytest.approx(-200.0)
    assert by_chance_of((BODY,), MASS, lost=500.0, unseen=2.0) == pytest.approx(5.0)


def test_of_two_under_the_floor_the_quieter_is_the_likelier(loaded: Problem) -> None:
    """A floor that was estimated too high hides from evidence what still tells two laws apart."""
    comparison = ModelComparison(loaded)
    rival = scored_model(comparison, single_effect(loaded, MASS, CARRIED))
    floor = np.full(len(loaded.signal_floor), 1.0)

    def leaving(fit: float, unseen: float) -> ScoredModel:
        seen = replace(rival.fitted, residual=np.full_like(rival.fitted.residual, fit))
        return replace(rival, fitted=seen, held_residual=np.full((5, len(floor)), unseen))

    usual = leaving(0.6, 0.5)
    assert compare_below_floor(leaving(0.4, 0.3), usual, floor) == 1
    assert compare_below_floor(usual, leaving(0.4, 0.3), floor) == -1
    # Both kinds of recordings have to say so, ...
    assert compare_below_floor(leaving(0.4, 0.5), usual, floor) == 0
    assert compare_below_floor(leaving(0.6, 0.3), usual, floor) == 0
    # ... and far under the floor nothing does.
    assert compare_below_floor(leaving(0.01, 0.01), leaving(0.15, 0.15), floor) == 0
