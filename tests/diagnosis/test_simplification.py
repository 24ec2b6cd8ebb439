"""Simplification: fewer effects or parameters that predict the same motion."""

from __future__ import annotations

import numpy as np
import pytest
from searched import named, searched
from test_elastic_transmissions import single_effect
from test_first_order import CRANK_JOINT, ELBOW, ROBOT, SHOULDER, carried, link, problem_of

from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.posterior import posterior
from pytest_twin.diagnosis.search.simplification import (
    equal_sized_forms,
    merge_joints,
    merge_terms,
    simpler_forms,
    split_terms,
)
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term

DELAYS = [Term("command_delay", j) for j in (SHOULDER, ELBOW)]
DRY = Term("coulomb_friction", ELBOW)
BACKLASH, ELASTICITY = Term("backlash", ELBOW), Term("joint_elasticity", ELBOW)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of("position", {DRY: {"coulomb": 0.1}})


def hypothesis_of(*terms: tuple[Term, list[float]]) -> Hypothesis:
    found = EMPTY
    for term, theta in terms:
        found = found.with_term(term, np.array(theta))
    return found


def test_command_delays_at_all_joints_can_be_merged_into_a_sensor_delay(problem: Problem) -> None:
    everywhere = hypothesis_of((DELAYS[0], [0.02]), (DRY, [0.1]), (DELAYS[1], [0.03]))
    (merged,) = merge_joints(problem, everywhere)
    assert merged.terms == (DRY, Term("sensor_delay", ROBOT))
    # The fit starts from their mean delay; from a distant value it would not converge.
    assert merged.theta == pytest.approx([0.1, 0.025])
    # The delay of a single joint is not merged.
    assert merge_joints(problem, everywhere.without(DELAYS[0])) == []


def test_thermal_friction_with_the_longest_time_constant_is_split_into_constant_friction(
    problem: Problem,
) -> None:
    thermal = Term("thermal_friction", SHOULDER)
    longest = thermal.parameters[2].upper
    dry, viscous = Term("coulomb_friction", SHOULDER), Term("viscous_friction", SHOULDER)
    constant = {"coulomb": 0.2, "viscous": 0.1}
    (both,) = split_terms(
        problem, hypothesis_of((DELAYS[1], [0.03]), (thermal, [*constant.values(), longest]))
    )
    assert both.terms == (DELAYS[1], dry, viscous)
    assert both.theta == pytest.approx([0.03, *constant.values()])
    assert split_terms(problem, hypothesis_of((thermal, [*constant.values(), 0.5 * longest]))) == []
    # An effect that is in the hypothesis is not added again.
    assert (
        split_terms(problem, hypothesis_of((dry, [0.1]), (thermal, [*constant.values(), longest])))
        == []
    )


def test_backlash_and_elasticity_can_be_merged_into_backlash_with_compliant_teeth(
    problem: Problem,
) -> None:
    (both,) = merge_terms(
        problem, hypothesis_of((BACKLASH, [0.03, 0.002]), (ELASTICITY, [0.004, 0.01]))
    )
    assert both.terms == (BACKLASH,)
    assert both.theta == pytest.approx([0.03, 0.006])
    # A larger compliance is limited to the bound of the teeth.
    (limited,) = merge_terms(
        problem, hypothesis_of((BACKLASH, [0.03, 0.002]), (ELASTICITY, [0.3, 0.01]))
    )
    assert limited.theta[1] == BACKLASH.parameters[1].upper


@pytest.mark.nightly
def test_a_smaller_torque_constant_and_less_friction_can_be_merged_into_servo_gains() -> None:
    """The fit changes the gains far from their starting values."""
    gain = Term("controller_gain", ELBOW)
    torque_constant, viscous = Term("torque_constant", ELBOW), Term("viscous_friction", ELBOW)
    smaller_gains = {"stiffness_error": -0.26, "damping_error": -0.4}
    problem = problem_of(
        "position", {BACKLASH: {"gap": 0.03, "tooth_compliance": 1e-4}, gain: smaller_gains}
    )
    backlash = single_effect(problem, BACKLASH, {"gap": 0.03, "tooth_compliance": 1e-4})
    # The servo keeps 0.42 of its 0.7 N m s/rad; the torque constant alone would leave 0.518.
    two = backlash
    for term, value in (
        (torque_constant, {"relative_error": -0.26}),
        (viscous, {"coefficient": -0.098}),
    ):
        two = two.with_term(term, single_effect(problem, term, value).theta)
    both = named(problem, two)
    assert set(both.terms) == {BACKLASH, gain}
    assert both.theta[both.slice_of(gain)] == pytest.approx([-0.26, -0.4], abs=0.01)


# -- forms of a law

LINK, LOAD = Term("inertial_parameters", ELBOW), Term("payload", ROBOT)


def form_of(hypothesis: Hypothesis, term: Term) -> float:
    names = [p.name for p in term.parameters]
    return float(hypothesis.theta[hypothesis.slice_of(term)][names.index("form")])


def test_a_changed_last_link_has_its_simpler_forms_and_a_payload_as_alternatives() -> None:
    problem = problem_of("position", {LOAD: carried(0.3, 0.2, 0.05)})
    richest = single_effect(problem, LINK, link(3, mass_error=0.6, radial=0.04, tangential=0.02))
    alternatives = simpler_forms(problem, richest)
    assert [form_of(h, LINK) for h in alternatives if h.terms == (LINK,)] == [0.0, 1.0, 2.0]
    loads = [h for h in alternatives if h.terms == (LOAD,)]
    assert [form_of(h, LOAD) for h in loads] == [0.0, 1.0, 2.0]
    # The first moment is the same: 0.3 kg on a link of 0.5 kg with its center at 0.125 m.
    mass, distance, sideways, *_ = (
        float(t) * problem.scales.value(p, ROBOT)
        for t, p in zip(loads[1].theta, LOAD.parameters, strict=True)
    )
    assert mass == pytest.approx(0.3)
    assert mass * distance == pytest.approx(0.8 * 0.165 - 0.5 * 0.125)
    assert abs(mass * sideways) == pytest.approx(0.8 * 0.02)
    # A link of unchanged mass has no payload, and the simplest form has no simpler one.
    moved = single_effect(problem, LINK, link(3, radial=0.04))
    assert all(h.terms == (LINK,) for h in simpler_forms(problem, moved))
    assert not simpler_forms(problem, single_effect(problem, LINK, link(0, relative_error=0.2)))


def test_a_heavier_link_is_reduced_to_its_simplest_form() -> None:
    problem = problem_of("position", {LINK: link(0, relative_error=0.4)})
    start = single_effect(problem, LINK, link(3, mass_error=0.4, inertia_error=0.4))
    simplest = named(problem, start)
    assert form_of(simplest, LINK) == 0.0
    assert simplest.theta[0] == pytest.approx(0.4, abs=0.01)


@pytest.mark.nightly
def test_other_wavenumbers_are_proposed_and_the_right_one_is_found() -> None:
    friction = Term("position_dependent_friction", ELBOW)
    true = {"mean": 0.3, "sine": 0.15, "cosine": 0.1, "harmonic": 1.0}
    problem = problem_of("position", {friction: true})
    wavenumber = [p.name for p in friction.parameters].index("harmonic")
    wrong = single_effect(problem, friction, true | {"harmonic": 2.0})
    alternatives = {h.theta[wavenumber] for h in equal_sized_forms(wrong)}
    assert 1.0 in alternatives
    assert 2.0 not in alternatives
    found = named(problem)
    assert found.theta == pytest.approx(single_effect(problem, friction, true).theta, abs=0.02)


# -- link inertia and rotor inertia

ROTOR = Term("armature", ELBOW)
CRANK_ROTOR, CRANK_LINK = (Term(e, CRANK_JOINT) for e in ("armature", "inertial_parameters"))


def test_additional_link_inertia_has_an_equal_rotor_inertia_as_alternative() -> None:
    problem = problem_of("position", {ROTOR: {"inertia": 0.004}})
    wider = single_effect(problem, LINK, link(2, inertia_error=1.5))
    (rotor,) = (h for h in simpler_forms(problem, wider) if h.terms == (ROTOR,))
    # Inertia of a capsule of 0.5 kg about a transverse axis through its center.
    model = problem.simulator.segments[0].model
    across = float(model.body_inertia[2].max())
    scale = problem.scales.value(ROTOR.parameters[0], ELBOW)
    assert rotor.theta * scale == pytest.approx(1.5 * across)
    # Not for a heavier link, and not if the hypothesis contains a rotor inertia.
    heavier = single_effect(problem, LINK, link(0, relative_error=0.2))
    named = wider.with_term(ROTOR, single_effect(problem, ROTOR, {"inertia": 0.01}).theta)
    for other in (heavier, named):
        assert not any(LINK not in h.terms for h in simpler_forms(problem, other))


def test_inertia_of_link_or_rotor_that_cannot_be_distinguished_shares_the_confidence() -> None:
    """With one joint, link inertia about the center of mass acts like rotor inertia."""
    problem = problem_of("effort", {CRANK_ROTOR: {"inertia": 0.02}})
    found = searched(problem)
    (term,) = found.incumbent.hypothesis.terms
    shares = posterior(found)
    assert shares.confidence[term] == pytest.approx(0.5, abs=0.1)
    (other,) = [a.new for a in shares.alternatives[term] if a.confidence > 0.2]
    assert {term, *other} == {CRANK_ROTOR, CRANK_LINK}


def test_inertia_that_a_preceding_joint_moves_too_is_not_assigned_to_the_rotor() -> None:
    problem = problem_of("position", {LINK: link(2, inertia_error=4.0)})
    start = single_effect(problem, LINK, link(2, inertia_error=4.0))
    assert named(problem, start).terms == (LINK,)
