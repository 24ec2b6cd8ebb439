"""Corrected parameters stay physically possible, and shape parameters identifiable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from searched import nominal_view
from simulated_robots import PENDULUM, SERVO, problem_of, with_values

from pytest_twin.diagnosis.physical_totals import (
    impossible_effects,
    totals,
    without_negative_totals,
)
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.recorded_range import RecordedRange, unidentifiable_effects
from pytest_twin.diagnosis.small_corrections import small_corrections
from pytest_twin.estimation.hypothesis import Term

DRAG, DRY = Term("viscous_friction", 0), Term("coulomb_friction", 0)
ROTOR, SPRING = Term("armature", 0), Term("joint_spring", 0)
RIPPLED = Term("position_dependent_friction", 0)
ONE_SIDED, DIRECTIONAL = Term("asymmetric_friction", 0), Term("directional_viscous_friction", 0)
STRIBECK, WARM_UP = Term("stribeck_friction", 0), Term("thermal_friction", 0)
COGGING, DELAY = Term("cogging", 0), Term("command_delay", 0)
CONSTANT = Term("torque_constant", 0)


@pytest.fixture(scope="module")
def problem() -> Problem:
    """A pendulum with damping 0.2, dry friction 0.1, armature 0.02 and no spring; 3 s at 100 Hz."""
    return problem_of(PENDULUM.format(drive=SERVO), "position", {DELAY: {"delay": 0.02}})


@pytest.mark.parametrize(
    ("term", "values", "name"),
    [
        (DRAG, {"coefficient": -0.25}, "viscous friction"),
        (DRY, {"coulomb": -0.15}, "dry friction"),
        (STRIBECK, {"coulomb": -0.15, "stiction_excess": 0.1}, "dry friction"),
        # Cut off at zero, friction of negative mean acts at some positions only.
        (RIPPLED, {"mean": -0.15, "sine": 0.3, "harmonic": 8.0}, "dry friction"),
        (ROTOR, {"inertia": -0.03}, "armature"),
        (SPRING, {"stiffness": -0.5}, "spring stiffness"),
    ],
    ids=[
        "viscous friction",
        "dry friction",
        "Stribeck friction",
        "friction over position",
        "armature",
        "spring",
    ],
)
def test_a_correction_below_the_models_own_value_is_impossible(
    problem: Problem, term: Term, values: dict[str, float], name: str
) -> None:
    (why,) = impossible_effects(problem, with_values(problem, {term: values})).values()
    assert name in why
    assert "below zero" in why


@pytest.mark.parametrize(
    ("term", "possible", "impossible_values"),
    [
        (ONE_SIDED, {"coulomb": 0.1, "offset": -0.19}, {"coulomb": 0.1, "offset": -0.25}),
        (DIRECTIONAL, {"difference": 0.19}, {"coefficient": 0.05, "difference": 0.3}),
    ],
    ids=["dry friction", "viscous friction"],
)
def test_friction_that_would_drive_the_joint_in_one_direction_is_impossible(
    problem: Problem, term: Term, possible: dict[str, float], impossible_values: dict[str, float]
) -> None:
    """A constant effort has other causes: an encoder zero, a spring, a tilted base."""
    assert not impossible_effects(problem, with_values(problem, {term: possible}))
    ((refused_effects, why),) = impossible_effects(
        problem, with_values(problem, {term: impossible_values})
    ).items()
    assert refused_effects == term
    assert "-0.05 in one direction, below zero" in why
    # Other friction of the joint adds to both directions.
    others = {DRY: {"coulomb": 0.1}, DRAG: {"coefficient": 0.1}}
    assert not impossible_effects(
        problem, with_values(problem, {term: impossible_values, **others})
    )


def test_a_correction_that_removes_all_of_the_models_friction_is_possible(
    problem: Problem,
) -> None:
    h = with_values(problem, {DRAG: {"coefficient": -0.2005}})
    assert not impossible_effects(problem, h)
    (total,) = totals(problem, h.with_theta(without_negative_totals(problem, h)))
    assert total.value == pytest.approx(0.0, abs=1e-12)


def test_corrections_of_one_quantity_are_added_before_the_total_is_checked(
    problem: Problem,
) -> None:
    both = with_values(problem, {DRY: {"coulomb": -0.15}, STRIBECK: {"coulomb": 0.1}})
    assert not impossible_effects(problem, both)
    assert set(impossible_effects(problem, both.without(STRIBECK))) == {DRY}
    # Friction may vanish in a part of the turn.
    wave = {"mean": -0.05, "sine": 0.3, "harmonic": 8.0}
    assert not impossible_effects(problem, with_values(problem, {RIPPLED: wave}))


@pytest.mark.parametrize(
    ("term", "values", "why"),
    [
        (WARM_UP, {"excess": 0.1, "warm_up_time": 902.0}, "warm up time of 902 s"),
        (STRIBECK, {"stiction_excess": 0.1, "stribeck_velocity": 50.0}, "greatest speed"),
        (COGGING, {"sine": 0.1, "harmonic": 190.0}, "190 periods a turn"),
    ],
    ids=["warm-up time", "Stribeck velocity", "wavenumber"],
)
def test_a_shape_parameter_outside_the_identifiable_range_is_rejected(
    problem: Problem, term: Term, values: dict[str, float], why: str
) -> None:
    h = with_values(problem, {term: values})
    coarse = replace(RecordedRange.of(problem), step=np.array([0.05]))
    assert why in unidentifiable_effects(problem, h, coarse)[term]


@pytest.mark.parametrize(
    ("term", "values"),
    [
        (WARM_UP, {"excess": 0.1, "warm_up_time": 2.0}),
        (STRIBECK, {"stiction_excess": 0.1, "stribeck_velocity": 0.1}),
        (COGGING, {"sine": 0.1, "harmonic": 6.0}),
    ],
    ids=["warm-up time", "Stribeck velocity", "wavenumber"],
)
def test_a_shape_parameter_within_the_identifiable_range_is_accepted(
    problem: Problem, term: Term, values: dict[str, float]
) -> None:
    assert not unidentifiable_effects(problem, with_values(problem, {term: values}))


def test_no_starting_value_is_outside_the_identifiable_range(problem: Problem) -> None:
    linearized = nominal_view(problem)
    p = next(p for p in WARM_UP.parameters if p.name == "warm_up_time")
    k = WARM_UP.parameters.index(p)
    starts = [
        float(r.start[k]) * problem.scales.value(p, 0)
        for r in linearized.sensitivities.responses
        if r.term == WARM_UP
    ]
    assert starts
    assert max(starts) <= 9.0, "at most three times the 3 s of a recording"


def test_a_correction_within_the_usual_accuracy_of_models_is_small(
    problem: Problem,
) -> None:
    values = {
        DELAY: {"delay": 0.0004},
        CONSTANT: {"relative_error": 0.01},
        DRAG: {"coefficient": 0.015},
        DRY: {"coulomb": 0.05},
    }
    h = with_values(problem, values)
    found = small_corrections(problem, h, np.full((4, 1), 0.01), np.array([0.01]))
    assert set(found) == {DELAY, CONSTANT, DRAG}


def test_an_effect_that_changes_less_than_a_tenth_of_the_error_is_small_if_others_explain_it(
    problem: Problem,
) -> None:
    h = with_values(problem, {DELAY: {"delay": 0.02}, DRY: {"coulomb": 0.05}})
    before = np.array([0.1])
    small = small_corrections(problem, h, np.array([[0.1], [0.005]]), before)
    assert set(small) == {DRY}
    # Without another effect, it is the finding.
    alone = h.without(DELAY)
    assert not small_corrections(problem, alone, np.array([[0.005]]), before)
