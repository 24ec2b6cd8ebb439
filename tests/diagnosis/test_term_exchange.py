"""Exchange of one or several effects of a fit for other effects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_elastic_transmissions import scored_model, single_effect
from test_first_order import ELBOW, ROBOT, SHOULDER, carried, problem_of

from pytest_twin.diagnosis.first_order.sensitivities import starting_grid
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.refusal import refused_effects
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search import alternatives
from pytest_twin.diagnosis.search.alternatives import AlternativeComparison
from pytest_twin.diagnosis.search.elimination import EliminationResult, have_same_forms
from pytest_twin.diagnosis.search.linearized_view import linearize_around
from pytest_twin.diagnosis.search.model_comparison import DECIDING_ITERATIONS, ModelComparison
from pytest_twin.diagnosis.search.scored_model import (
    ScoredModel,
    SelectedModel,
    compare_below_floor,
)
from pytest_twin.diagnosis.search.simplification import simpler_forms
from pytest_twin.diagnosis.search.term_exchange import (
    TermExchange,
    better_as_addition,
    better_than_several,
    chance_gain,
    find_exchanges,
    simulated_evidence,
)
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term

MASS, BODY = Term("payload", ROBOT), Term("inertial_parameters", ELBOW)
SPRING, REFLECTED = Term("joint_spring", ELBOW), Term("armature", ELBOW)
DRAG, DRY = Term("viscous_friction", ELBOW), Term("coulomb_friction", ELBOW)
LOADS = (MASS, BODY)
"""Effects that represent a load: a last link with other mass and center contains a payload."""
CARRIED = carried(0.3, 0.2)
FRICTION = {DRAG: {"coefficient": 0.2}, DRY: {"coulomb": 0.3}}


@pytest.fixture(scope="module")
def with_payload() -> Problem:
    return problem_of("position", {MASS: CARRIED})


def converged(comparison: ModelComparison, *terms: Term) -> ScoredModel:
    """A model of these terms, fitted from their first starting sizes until convergence."""
    start = EMPTY
    for t in terms:
        start = start.with_term(t, starting_grid(t)[0][0])
    return comparison.fit_to_convergence(
        comparison.fit_models([start], comparison.nominal, DECIDING_ITERATIONS)[0]
    )


def exchanges(
    problem: Problem, comparison: ModelComparison, best: ScoredModel
) -> list[TermExchange]:
    return find_exchanges(best, linearize_around(best), comparison.penalty_per_effect)


def payload_of(problem: Problem, exchange: TermExchange) -> Hypothesis:
    """The payload of an exchange, or the payload that its last link represents."""
    there = exchange.hypothesis
    return next(h for h in (there, *simpler_forms(problem, there)) if h.terms == (MASS,))


def test_two_correlated_wrong_effects_are_exchanged_for_the_right_one(
    with_payload: Problem,
) -> None:
    comparison = ModelComparison(with_payload)
    best = converged(comparison, SPRING, REFLECTED)
    found = [
        x
        for x in exchanges(with_payload, comparison, best)
        if x.new in LOADS and len(x.removed) == 2
    ]
    (one,) = found
    assert one.removed == (SPRING, REFLECTED)
    assert one.evidence > 0.0
    assert one.hypothesis.terms == (one.new,)
    true = single_effect(with_payload, MASS, CARRIED)
    assert np.prod(payload_of(with_payload, one).theta[:2]) == pytest.approx(
        np.prod(true.theta[:2]), rel=0.1
    )


def test_the_removal_of_a_needed_effect_loses_evidence() -> None:
    problem = problem_of("position", FRICTION)
    comparison = ModelComparison(problem)
    both = single_effect(problem, DRAG, FRICTION[DRAG]).with_term(
        DRY, single_effect(problem, DRY, FRICTION[DRY]).theta
    )
    found = exchanges(problem, comparison, scored_model(comparison, both))
    bare = {x.removed: x.evidence for x in found if x.new is None}
    assert bare.keys() == {(DRAG,), (DRY,)}
    assert max(bare.values()) < -30.0
    # An effect that remains in the fit is not proposed again.
    assert not any(x.new in both.without(*x.removed).terms for x in found)


def test_an_alternative_is_scored_with_its_own_discretization_error(
    with_payload: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    comparison = ModelComparison(with_payload)
    best = scored_model(comparison, EMPTY)
    # The discretization errors of both models differ.
    rival = scored_model(comparison, single_effect(with_payload, MASS, CARRIED))
    corrected_at: list[Hypothesis] = []

    def at(problem: Problem, hypothesis: Hypothesis) -> Problem:
        corrected_at.append(hypothesis)
        return problem

    monkeypatch.setattr(Problem, "at", at)
    for evidence in (-3.0, -1e5, 10.0):
        rival.evidence = evidence
        assert AlternativeComparison(comparison).score_with_own_correction(rival, best) is rival
    assert corrected_at == []
    rival.evidence = -400.0
    assert AlternativeComparison(comparison).score_with_own_correction(rival, best).evidence > 0.0
    assert corrected_at == [rival.hypothesis]


def test_both_effects_of_an_exchange_are_kept_if_together_they_are_better() -> None:
    problem = problem_of("position", FRICTION)
    comparison = ModelComparison(problem)
    best, top = converged(comparison, DRAG), converged(comparison, DRY)
    comparison.score_models([top], best)
    assert set(
        AlternativeComparison(comparison).exchange_or_addition(best, top).hypothesis.terms
    ) == {
        DRAG,
        DRY,
    }
    # Only the new effect is kept if the old one is not needed.
    other = problem_of("position", {DRY: FRICTION[DRY]})
    comparison = ModelComparison(other)
    best, top = converged(comparison, DRAG), converged(comparison, DRY)
    comparison.score_models([top], best)
    assert AlternativeComparison(comparison).exchange_or_addition(best, top) is top


def test_the_search_exchanges_two_wrong_effects_for_the_right_one(with_payload: Problem) -> None:
    comparison = ModelComparison(with_payload)
    selected = SelectedModel(converged(comparison, SPRING, REFLECTED), comparison.nominal)
    exchanged = AlternativeComparison(comparison).exchange(selected, {})
    assert exchanged is not None
    assert exchanged.best.hypothesis.terms == (MASS,)
    true = single_effect(with_payload, MASS, CARRIED)
    moment, its = (np.prod(h.theta[:2]) for h in (exchanged.best.hypothesis, true))
    assert moment == pytest.approx(its, rel=0.1)


def test_an_effect_that_explains_another_part_of_the_residual_is_no_alternative() -> None:
    """Viscous friction at the elbow is in the fit; dry friction at the shoulder is missing."""
    dry_friction = Term("coulomb_friction", SHOULDER)
    problem = problem_of("position", {DRAG: FRICTION[DRAG], dry_friction: {"coulomb": 1.0}})
    comparison = ModelComparison(problem)
    best = converged(comparison, DRAG)
    linearized = linearize_around(best)
    found = exchanges(problem, comparison, best)
    penalty = comparison.penalty_per_effect
    additions = better_as_addition(best, linearized, found, 30.0, penalty)
    hypothesis, evidence = additions[dry_friction]
    assert set(hypothesis.terms) == {DRAG, dry_friction}
    assert hypothesis.theta[hypothesis.slice_of(dry_friction)] > 0.0
    (exchange_of_drag,) = [x for x in found if x.removed == (DRAG,) and x.new == dry_friction]
    assert evidence > exchange_of_drag.evidence > 30.0, (
        "the exchange must gain evidence, and the addition more"
    )
    assert not better_as_addition(best, linearized, found, evidence + 1.0, penalty), (
        "no addition is clearly better"
    )

    selected = SelectedModel(best, comparison.nominal)
    exchanged = AlternativeComparison(comparison).exchange(selected, {})
    assert exchanged is not None
    assert set(exchanged.best.hypothesis.terms) == {DRAG, dry_friction}
    assert selected.confidence[DRAG] > 0.99
    assert all(
        rival.joint != SHOULDER for rival, share in selected.alternatives[DRAG] if share > 0.01
    )


def test_a_clearly_better_addition_is_tried_instead_of_several_effects() -> None:
    """A torque that falls with speed was found as a limit and drag. As a replacement of both, its
    shape is that of its fit as an addition.
    """
    torque_speed = Term("torque_speed_limit", ELBOW)
    hidden = {"inverse_no_load_speed": 1.0 / 1.5, "stall": 2.5}
    problem = problem_of("position", {torque_speed: hidden})
    comparison = ModelComparison(problem)
    limit, drag = Term("torque_saturation", ELBOW), Term("quadratic_drag", ELBOW)
    best = converged(comparison, limit, drag)
    linearized, penalty = linearize_around(best), comparison.penalty_per_effect
    true = single_effect(problem, torque_speed, hidden)
    both = best.hypothesis.with_term_of(true, torque_speed)
    old = TermExchange((limit, drag), torque_speed, EMPTY, -85.0, False)
    elsewhere = TermExchange((limit,), DRY, EMPTY, -4.0, False)

    proposed = better_than_several(
        best, linearized, [old, elsewhere], {torque_speed: (both, 50.0)}, penalty
    )
    assert proposed[0] is elsewhere
    (one,) = proposed[1:]
    assert (one.removed, one.new) == ((limit, drag), torque_speed)
    assert one.evidence > 30.0
    assert one.hypothesis.terms == (torque_speed,)
    assert one.hypothesis.theta == pytest.approx(true.theta, rel=0.05)
    # Nothing is changed without a clearly better addition at a joint with several effects.
    assert better_than_several(best, linearized, [old], {}, penalty) == [old]
    brake = Term("coulomb_friction", SHOULDER)
    at_shoulder = best.hypothesis.with_term(brake, np.array([0.1]))
    assert better_than_several(best, linearized, [old], {brake: (at_shoulder, 50.0)}, penalty) == [
        old
    ]


def test_the_right_effect_is_an_alternative_although_it_is_also_better_as_an_addition() -> None:
    problem = problem_of("position", {DRY: FRICTION[DRY]})
    comparison = ModelComparison(problem)
    best = converged(comparison, DRAG)
    found = exchanges(problem, comparison, best)
    additions = better_as_addition(
        best, linearize_around(best), found, 30.0, comparison.penalty_per_effect
    )
    (exchange_of_drag,) = [x for x in found if x.removed == (DRAG,) and x.new == DRY]
    assert 30.0 < additions[DRY][1] < exchange_of_drag.evidence, (
        "the unneeded effect must cost its penalty"
    )
    selected = SelectedModel(best, comparison.nominal)
    exchanged = AlternativeComparison(comparison).exchange(selected, {})
    assert exchanged is not None
    assert selected.confidence[DRAG] < 1e-3
    # Another law of dry friction may be exchanged first.
    selected.best = exchanged.best
    again = (
        AlternativeComparison(comparison).exchange(selected, exchanged.simplification_evidence)
        or exchanged
    )
    assert again.best.hypothesis.terms == (DRY,)


def test_two_effects_that_are_exchanged_for_each_other_are_equally_likely(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """If elimination reverses an exchange, both effects have the same evidence, and the search
    ends.
    """
    problem = problem_of("position", {DRAG: FRICTION[DRAG]})
    run = Run()
    comparison = ModelComparison(problem, run)
    drag = Term("quadratic_drag", DRAG.joint)
    best = converged(comparison, drag)
    selected = SelectedModel(best, comparison.nominal)
    monkeypatch.setattr(alternatives, "eliminate", lambda *_: EliminationResult(best, {}))
    assert AlternativeComparison(comparison).exchange(selected, {}) is None
    shares = {t.effect: share for t, share in selected.alternatives[drag]}
    last = run.trace.steps[-1]
    assert (last.move, last.decision) == ("exchange", "accepted")
    (better,) = [e for e in shares if any(name.startswith(f"{e} at ") for name in last.proposed)]
    assert shares[better] == pytest.approx(selected.confidence[drag], rel=1e-9)
    # Another form of the same law is another model.
    of_rate, of_effort = (
        Hypothesis((Term("rate_limit", SHOULDER),), np.array([1.0, 1.0, choice]))
        for choice in (0.0, 1.0)
    )
    assert have_same_forms(of_rate, of_rate.with_theta(0.5 * of_rate.theta))
    assert not have_same_forms(of_rate, of_effort)


def test_an_effect_is_not_exchanged_for_one_that_cannot_exist() -> None:
    """A total damping below zero compensates for another effect, however well it fits."""
    problem = problem_of("position", {DRAG: {"coefficient": -0.4}})
    comparison = ModelComparison(problem)
    best, other = (converged(comparison, term) for term in (SPRING, DRAG))
    comparison.score_models([other], best)
    assert other.evidence > 1.0
    assert refused_effects(problem, other.hypothesis)
    selected = SelectedModel(best, comparison.nominal)
    exchanged = AlternativeComparison(comparison).exchange(selected, {})
    kept = selected.best if exchanged is None else exchanged.best
    assert DRAG not in kept.hypothesis.terms
    assert DRAG not in [term for term, _ in selected.alternatives.get(SPRING, [])]


def test_the_simulated_evidence_of_a_removal_replaces_the_linearized_one() -> None:
    problem = problem_of("position", {DRAG: FRICTION[DRAG]})
    comparison = ModelComparison(problem)
    selected = SelectedModel(converged(comparison, DRAG), comparison.nominal)
    compared = AlternativeComparison(comparison)
    assert compared.exchange(selected, {}) is None
    assert selected.confidence[DRAG] > 0.9
    compared.exchange(selected, {(): 20.0})
    assert selected.confidence[DRAG] < 1e-3
    # Without a simulation of this removal, the linearized evidence is used.
    compared.exchange(selected, {(SPRING,): 20.0})
    assert selected.confidence[DRAG] > 0.9


def test_a_more_general_law_is_not_listed_as_an_alternative() -> None:
    problem = problem_of("position", {DRY: FRICTION[DRY]})
    comparison = ModelComparison(problem)
    best = converged(comparison, DRY)
    proposed = [
        x.new for x in exchanges(problem, comparison, best) if x.removed == (DRY,) and x.new
    ]
    assert any(DRY.effect in new.law.generalizes for new in proposed)
    selected = SelectedModel(best, comparison.nominal)
    assert AlternativeComparison(comparison).exchange(selected, {}) is None
    assert selected.alternatives[DRY]
    assert not any(DRY.effect in new.law.generalizes for new, _ in selected.alternatives[DRY])


def test_only_alternatives_that_lose_little_evidence_are_simulated(
    with_payload: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    comparison = ModelComparison(with_payload)
    best = scored_model(comparison, single_effect(with_payload, MASS, CARRIED))
    monkeypatch.setattr(comparison, "fit_models", lambda starts, *rest: [best] * len(starts))
    compared, removed = AlternativeComparison(comparison), (MASS,)

    def simulated(lost: float, behind: float) -> list[Term | None]:
        found = [
            TermExchange(removed, None, EMPTY, lost, False),
            TermExchange(
                removed, DRAG, single_effect(with_payload, DRAG, FRICTION[DRAG]), behind, False
            ),
        ]
        return [x.new for x, _ in compared.simulated_exchanges(best, found, ())]

    assert simulated(lost=-500.0, behind=-20.0) == [DRAG]
    assert simulated(lost=-500.0, behind=-40.0) == []
    assert simulated(lost=-5000.0, behind=-200.0) == [DRAG]
    assert simulated(lost=-5000.0, behind=-300.0) == []

    # For several removed effects, the largest loss of a single one counts.
    several = [
        TermExchange((MASS,), None, EMPTY, -5000.0, False),
        TermExchange((DRY,), None, EMPTY, -3.0, False),
        TermExchange(
            (MASS, DRY), DRAG, single_effect(with_payload, DRAG, FRICTION[DRAG]), -200.0, False
        ),
    ]
    assert [x.new for x, _ in compared.simulated_exchanges(best, several, ())] == [DRAG]
    assert compared.simulated_exchanges(best, several[1:], ()) == []


def at_starts(*terms: Term) -> Hypothesis:
    return EMPTY.with_terms({t: starting_grid(t)[0][0] for t in terms})


def chance_gain_of(
    removed: tuple[Term, ...], new: Term | None, lost: float, unseen: float = 1.0
) -> float:
    bare = TermExchange(removed, None, EMPTY, -lost, False)
    there = at_starts(new) if new else EMPTY
    other = TermExchange(removed, new, there, 7.0, False)
    return chance_gain(at_starts(*removed), [bare, other], unseen)[removed, new]


def test_an_effect_with_more_parameters_gains_evidence_by_chance() -> None:
    assert chance_gain_of((BODY,), MASS, lost=500.0) == pytest.approx(5.0)
    assert chance_gain_of((BODY,), MASS, lost=1e5) == pytest.approx(15.0)
    # There is no gain by chance without a loss, and none with as many parameters.
    assert chance_gain_of((BODY,), MASS, lost=-3.0) == 0.0
    assert chance_gain_of((DRAG,), DRY, lost=1e5) == 0.0
    assert chance_gain_of((DRAG, DRY), MASS, lost=1e5) == 0.0
    assert chance_gain_of((MASS, DRY), DRAG, lost=1e5) == 0.0
    assert chance_gain_of((DRAG,), None, lost=1e5) == 0.0


def test_an_effect_with_fewer_parameters_loses_evidence_by_chance() -> None:
    assert chance_gain_of((MASS,), DRAG, lost=500.0) == pytest.approx(-5.0)
    assert chance_gain_of((MASS,), DRAG, lost=1e5) == pytest.approx(-15.0)
    assert chance_gain_of((MASS,), DRAG, lost=-3.0) == 0.0


def test_exchanges_that_were_not_simulated_lose_as_much_evidence_as_the_simulated_ones() -> None:
    """Otherwise exchanges that were only linearized would be likelier than simulated ones."""
    bare, drag, dry, mass, backlash, elsewhere = found = [
        TermExchange((BODY,), None, EMPTY, -2000.0, False),
        TermExchange((BODY,), DRAG, EMPTY, 41.0, False),
        TermExchange((BODY,), DRY, EMPTY, 29.0, False),
        TermExchange((BODY,), MASS, EMPTY, 27.0, False),
        TermExchange((BODY,), Term("backlash", ELBOW), EMPTY, 500.0, True),
        TermExchange((DRAG,), MASS, EMPTY, 12.0, False),
    ]
    evidence = simulated_evidence(found, [(drag, -60.0), (dry, -3600.0)])
    assert [evidence[x.removed, x.new] for x in (drag, dry, mass)] == [-60.0, -3600.0, 27.0 - 101.0]
    # Removals, exchanges that the linearization does not show, and exchanges of another effect keep
    # their evidence.
    assert [evidence[x.removed, x.new] for x in (bare, backlash, elsewhere)] == [
        -2000.0,
        500.0,
        12.0,
    ]
    # An exchange that gains evidence by its simulation does not change the others.
    assert simulated_evidence(found, [(drag, 90.0)])[mass.removed, mass.new] == 27.0


def test_a_generalization_must_have_clearly_more_evidence_than_its_special_case() -> None:
    """Servo gains contain viscous friction, and friction over position contains dry friction."""
    gain, wavy = Term("controller_gain", ELBOW), Term("position_dependent_friction", ELBOW)
    assert chance_gain_of((DRAG,), gain, lost=1e4) == pytest.approx(200.0)
    assert chance_gain_of((DRY,), wavy, lost=1e4) == pytest.approx(200.0)
    assert chance_gain_of((wavy,), DRY, lost=1e4) == pytest.approx(-100.0)
    # With twice the number of samples, the gain by chance is doubled.
    assert chance_gain_of((DRAG,), gain, lost=1e4, unseen=2.0) == pytest.approx(400.0)
    assert chance_gain_of((wavy,), DRY, lost=1e4, unseen=2.0) == pytest.approx(-200.0)
    assert chance_gain_of((BODY,), MASS, lost=500.0, unseen=2.0) == pytest.approx(5.0)


def test_of_two_models_below_the_noise_floor_the_smaller_residual_is_likelier(
    with_payload: Problem,
) -> None:
    """The evidence cannot distinguish two residuals below a floor that is estimated too high."""
    comparison = ModelComparison(with_payload)
    rival = scored_model(comparison, single_effect(with_payload, MASS, CARRIED))
    floor = np.full(len(with_payload.signal_floor), 1.0)

    def with_residuals(fit: float, unseen: float) -> ScoredModel:
        seen = replace(rival.fitted, residual=np.full_like(rival.fitted.residual, fit))
        return replace(rival, fitted=seen, held_residual=np.full((5, len(floor)), unseen))

    reference = with_residuals(0.6, 0.5)
    assert compare_below_floor(with_residuals(0.4, 0.3), reference, floor) == 1
    assert compare_below_floor(reference, with_residuals(0.4, 0.3), floor) == -1
    # Fit and validation recordings must agree.
    assert compare_below_floor(with_residuals(0.4, 0.5), reference, floor) == 0
    assert compare_below_floor(with_residuals(0.6, 0.3), reference, floor) == 0
    # Far below the floor, the difference carries no information.
    assert compare_below_floor(with_residuals(0.01, 0.01), with_residuals(0.15, 0.15), floor) == 0
