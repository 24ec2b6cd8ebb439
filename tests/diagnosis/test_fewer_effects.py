"""The same physics in fewer words."""

from __future__ import annotations

import numpy as np
import pytest
from test_behind_gears import fitted, with_true
from test_first_order import CRANK_JOINT, ELBOW, ROBOT, SHOULDER, carried, link, problem_of

from pytest_twin.diagnosis.first_order.sensitivities import linearize
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.simplification import (
    equal_sized_forms,
    merge_joints,
    merge_terms,
    simpler_forms,
    split_terms,
)
from pytest_twin.diagnosis.search.stepwise_selection import StepwiseSelection

LATE = [Term("command_delay", j) for j in (SHOULDER, ELBOW)]
DRY = Term("coulomb_friction", ELBOW)
PLAY, SOFT = Term("backlash", ELBOW), Term("joint_elasticity", ELBOW)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of("position", {DRY: {"coulomb": 0.1}})


def of(*terms: tuple[Term, list[float]]) -> Hypothesis:
    found = EMPTY
    for term, theta in terms:
        found = found.with_term(term, np.array(theta))
    return found


def test_late_commands_at_every_joint_may_be_late_sensors(problem: Problem) -> None:
    everywhere = of((LATE[0], [0.02]), (DRY, [0.1]), (LATE[1], [0.03]))
    (late,) = merge_joints(problem, everywhere)
    assert late.terms == (DRY, Term("sensor_delay", ROBOT))
    # It starts as late as they are: where efforts jump, a search from afar would not find there.
    assert late.theta == pytest.approx([0.1, 0.025])
    # One joint whose commands are late is that joint's.
    assert merge_joints(problem, everywhere.without(LATE[0])) == []


def test_friction_that_takes_for_ever_to_fade_is_friction_that_stays(problem: Problem) -> None:
    fades = Term("thermal_friction", SHOULDER)
    longest = fades.parameters[2].upper
    dry, viscous = Term("coulomb_friction", SHOULDER), Term("viscous_friction", SHOULDER)
    stays = {"coulomb": 0.2, "viscous": 0.1}
    (both,) = split_terms(problem, of((LATE[1], [0.03]), (fades, [*stays.values(), longest])))
    assert both.terms == (LATE[1], dry, viscous)
    assert both.theta == pytest.approx([0.03, *stays.values()])
    assert split_terms(problem, of((fades, [*stays.values(), 0.5 * longest]))) == []
    # What is named already is not named twice.
    assert split_terms(problem, of((dry, [0.1]), (fades, [*stays.values(), longest]))) == []


def test_an_elastic_gear_beside_play_is_its_teeth(problem: Problem) -> None:
    (both,) = merge_terms(problem, of((PLAY, [0.03, 0.002]), (SOFT, [0.004, 0.01])))
    assert both.terms == (PLAY,)
    assert both.theta == pytest.approx([0.03, 0.006])
    # More than teeth can yield stays within their bounds, and leaves what it does to be seen.
    (soft,) = merge_terms(problem, of((PLAY, [0.03, 0.002]), (SOFT, [0.3, 0.01])))
    assert soft.theta[1] == PLAY.parameters[1].upper


def test_a_weak_motor_with_a_brake_too_few_is_a_soft_servo() -> None:
    """Gains start far from what the two come to, and are followed that far."""
    gain = Term("controller_gain", ELBOW)
    weak, brake = Term("torque_constant", ELBOW), Term("viscous_friction", ELBOW)
    soft = {"stiffness_error": -0.26, "damping_error": -0.4}
    problem = problem_of("position", {PLAY: {"gap": 0.03, "tooth_compliance": 1e-4}, gain: soft})
    play = with_true(problem, PLAY, {"gap": 0.03, "tooth_compliance": 1e-4})
    # Of the servo's 0.7 N m s/rad 0.42 are left: a constant leaves 0.518.
    two = play
    for term, value in ((weak, {"relative_error": -0.26}), (brake, {"coefficient": -0.098})):
        two = two.with_term(term, with_true(problem, term, value).theta)
    selection = StepwiseSelection(problem)
    best = fitted(selection.comparison, two)
    linear = linearize(problem, problem.fit, two)
    (both,) = selection.undecided(best, linear, merge_terms(problem, two), lambda other: 0.0)
    assert set(both.terms) == {PLAY, gain}
    assert both.theta[both.slice_of(gain)] == pytest.approx([-0.26, -0.4], abs=0.01)


# -- forms of a law

LINK, LOAD = Term("inertial_parameters", ELBOW), Term("payload", ROBOT)


def in_form(hypothesis: Hypothesis, term: Term) -> float:
    names = [p.name for p in term.parameters]
    return float(hypothesis.theta[hypothesis.slice_of(term)][names.index("form")])


def test_a_last_link_is_offered_in_its_simpler_forms_and_as_what_carries_a_load() -> None:
    problem = problem_of("position", {LOAD: carried(0.3, 0.2, 0.05)})
    richest = with_true(problem, LINK, link(3, mass_error=0.6, radial=0.04, tangential=0.02))
    offered = simpler_forms(problem, richest)
    assert [in_form(h, LINK) for h in offered if h.terms == (LINK,)] == [0.0, 1.0, 2.0]
    loads = [h for h in offered if h.terms == (LOAD,)]
    assert [in_form(h, LOAD) for h in loads] == [0.0, 1.0, 2.0]
    # The same first moment: 0.3 kg added to 0.5 kg whose centre was 0.125 m out.
    mass, distance, sideways, *_ = (
        float(t) * problem.scales.value(p, ROBOT)
        for t, p in zip(loads[1].theta, LOAD.parameters, strict=True)
    )
    assert mass == pytest.approx(0.3)
    assert mass * distance == pytest.approx(0.8 * 0.165 - 0.5 * 0.125)
    assert abs(mass * sideways) == pytest.approx(0.8 * 0.02)
    # A link of the same mass carries nothing, and what is simplest has no simpler form.
    moved = with_true(problem, LINK, link(3, radial=0.04))
    assert all(h.terms == (LINK,) for h in simpler_forms(problem, moved))
    assert not simpler_forms(problem, with_true(problem, LINK, link(0, relative_error=0.2)))


def test_a_heavier_link_comes_to_its_simplest_form() -> None:
    problem = problem_of("position", {LINK: link(0, relative_error=0.4)})
    selection = StepwiseSelection(problem)
    comparison = selection.comparison
    start = with_true(problem, LINK, link(3, mass_error=0.4, inertia_error=0.4))
    best = comparison.fit_to_convergence(
        comparison.rivals([start], comparison.weights(comparison.nominal), 2)[0]
    )
    assert in_form(best.hypothesis, LINK) == 3.0
    simplest = selection.eliminate(best).hypothesis
    assert in_form(simplest, LINK) == 0.0
    assert simplest.theta[0] == pytest.approx(0.4, abs=0.01)


def test_a_form_with_more_may_be_ahead_by_a_share_of_what_its_law_does() -> None:
    problem = problem_of("position", {LINK: link(3, mass_error=0.5, tangential=0.02)})
    selection = StepwiseSelection(problem)
    true = with_true(problem, LINK, link(3, mass_error=0.5, tangential=0.02))
    best = fitted(selection.comparison, true)
    grace = selection.tolerances(best, linearize(problem, problem.fit, true))
    simpler = with_true(problem, LINK, link(1, mass_error=0.5))
    assert grace(simpler) > 5.0
    assert grace(EMPTY) == 0.0
    # One with as many says nothing in fewer words: it has to be better.
    assert grace(true) < 0.0
    # Far from enough for one that leaves what is seen.
    assert in_form(selection.eliminate(best).hypothesis, LINK) == 3.0


def test_a_law_comes_to_the_form_that_was_not_seen_when_it_was_named() -> None:
    rough = Term("position_dependent_friction", ELBOW)
    true = {"mean": 0.3, "sine": 0.15, "cosine": 0.1, "harmonic": 1.0}
    problem = problem_of("position", {rough: true})
    crests = [p.name for p in rough.parameters].index("harmonic")
    selection = StepwiseSelection(problem)
    best = fitted(selection.comparison, with_true(problem, rough, true | {"harmonic": 2.0}))
    offered = {h.theta[crests] for h in equal_sized_forms(best.hypothesis)}
    assert 1.0 in offered
    assert 2.0 not in offered
    found = selection.eliminate(best).hypothesis
    assert found.theta == pytest.approx(with_true(problem, rough, true).theta, abs=0.02)


# -- a link's inertia and a rotor's

ROTOR = Term("armature", ELBOW)
CRANK_ROTOR, CRANK_LINK = (Term(e, CRANK_JOINT) for e in ("armature", "inertial_parameters"))


def test_more_inertia_of_a_link_is_offered_as_a_rotor_of_as_much() -> None:
    problem = problem_of("position", {ROTOR: {"inertia": 0.004}})
    wider = with_true(problem, LINK, link(2, inertia_error=1.5))
    (rotor,) = (h for h in simpler_forms(problem, wider) if h.terms == (ROTOR,))
    # A capsule of 0.5 kg about the axis across it, through its centre.
    model = problem.simulator.segments[0].model
    across = float(model.body_inertia[2].max())
    scale = problem.scales.value(ROTOR.parameters[0], ELBOW)
    assert rotor.theta * scale == pytest.approx(1.5 * across)
    # Not of a link that is heavier too, nor beside a rotor that is named.
    heavier = with_true(problem, LINK, link(0, relative_error=0.2))
    named = wider.with_term(ROTOR, with_true(problem, ROTOR, {"inertia": 0.01}).theta)
    for other in (heavier, named):
        assert not any(LINK not in h.terms for h in simpler_forms(problem, other))


def test_where_nothing_tells_them_apart_more_inertia_is_the_rotors() -> None:
    """One joint: a link of more inertia about its centre of mass moves as one with a rotor does."""
    problem = problem_of("effort", {CRANK_ROTOR: {"inertia": 0.02}})
    selection = StepwiseSelection(problem)
    comparison = selection.comparison
    start = with_true(problem, CRANK_LINK, link(2, inertia_error=2.0))
    best = comparison.fit_to_convergence(
        comparison.rivals([start], comparison.weights(comparison.nominal), 2)[0]
    )
    assert best.hypothesis.terms == (CRANK_LINK,)
    simplest = selection.eliminate(best).hypothesis
    assert simplest.terms == (CRANK_ROTOR,)
    scale = problem.scales.value(CRANK_ROTOR.parameters[0], CRANK_JOINT)
    assert simplest.theta[0] * scale == pytest.approx(0.02, rel=0.05)


def test_a_link_that_the_joint_before_turns_too_is_no_rotor() -> None:
    problem = problem_of("position", {LINK: link(2, inertia_error=4.0)})
    selection = StepwiseSelection(problem)
    best = fitted(selection.comparison, with_true(problem, LINK, link(2, inertia_error=4.0)))
    assert selection.eliminate(best).hypothesis.terms == (LINK,)
