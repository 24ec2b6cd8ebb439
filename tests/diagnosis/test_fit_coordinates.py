"""Coordinates in which a fit steps, and terms that one law can represent together."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_first_order import ELBOW, SHOULDER, carried, problem_of

from pytest_twin.diagnosis.search.simplification import merge_terms
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import Effect
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.estimation.least_squares import fit, propose_step

PAYLOAD = Term("payload", -1)


@given(st.floats(-0.9, 20.0), st.floats(0.05, 4.0))
def test_a_payload_equals_its_coordinates_transformed_back(mass: float, distance: float) -> None:
    law = catalogue()["payload"]
    in_line = np.array([mass, distance, 0.0, 0.0, 0.0])
    coordinates = law.coordinates(in_line)
    assert coordinates[:2] == pytest.approx([mass * distance, distance])
    assert law.from_coordinates(coordinates) == pytest.approx(in_line)
    # A payload beside the x axis has a moment at distance zero.
    aside = np.array([mass, 0.0, distance, 0.0, 1.0])
    assert law.from_coordinates(law.coordinates(aside)) == pytest.approx(aside)


def test_a_fit_corrects_mass_and_distance_of_a_payload_whose_moment_is_right(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The linearized search finds the right moment, with half the mass at twice the distance."""
    problem = problem_of("position", {PAYLOAD: carried(0.6, 0.25)})
    scales = [problem.scales.value(p, 0) for p in PAYLOAD.parameters]
    truth = np.array(list(carried(0.6, 0.25).values())) / scales
    start = truth * [0.5, 2.0, 1.0, 1.0, 1.0]
    weights = 1.0 / problem.signal_floor

    def cost() -> float:
        started = [EMPTY.with_term(PAYLOAD, start)]
        return fit(problem, started, weights, problem.fit, iterations=4)[0].cost

    assert cost() < 2.0
    law = type(catalogue()["payload"])
    monkeypatch.setattr(law, "coordinates", Effect.coordinates)
    monkeypatch.setattr(law, "from_coordinates", Effect.from_coordinates)
    assert cost() > 100.0


def test_a_law_absorbs_its_special_case() -> None:
    """Coulomb and Stribeck friction together are a Stribeck friction; their levels add up."""
    plain, rich = Term("coulomb_friction", ELBOW), Term("stribeck_friction", ELBOW)
    both = Hypothesis((plain, rich), np.array([0.7, -0.4, 0.5, 0.2]))
    one = both.with_absorbed(plain, rich)
    assert one is not None
    assert one.terms == (rich,)
    assert one.theta == pytest.approx([0.3, 0.5, 0.2])
    assert both.with_absorbed(rich, plain) is None


def test_servo_gains_absorb_a_torque_constant() -> None:
    """A quarter of the stiffness times twice the torque constant is half the stiffness."""
    servo, drive = Term("controller_gain", SHOULDER), Term("torque_constant", SHOULDER)
    both = Hypothesis((servo, drive), np.array([-0.75, -0.4, 1.0]))
    one = both.with_absorbed(drive, servo)
    assert one is not None
    assert one.terms == (servo,)
    assert one.theta == pytest.approx([-0.5, 0.2])
    assert both.with_absorbed(servo, drive) is None
    problem = problem_of("position", {servo: {"stiffness_error": -0.5, "damping_error": 0.2}})
    assert (servo,) in [h.terms for h in merge_terms(problem, both)]


def test_two_terms_are_merged_into_one_law_that_is_confused_with_both() -> None:
    """A smaller torque constant with viscous friction may be a servo with other gains."""
    problem = problem_of("position", {Term("controller_gain", SHOULDER): {
        "stiffness_error": -0.3, "damping_error": 0.2}})  # fmt: skip
    pair = (Term("torque_constant", SHOULDER), Term("viscous_friction", SHOULDER))
    offered = merge_terms(problem, Hypothesis(pair, np.array([-0.3, 0.1])))
    assert (Term("controller_gain", SHOULDER),) in [h.terms for h in offered]
    apart = (Term("torque_constant", SHOULDER), Term("viscous_friction", ELBOW))
    assert not merge_terms(problem, Hypothesis(apart, np.array([-0.3, 0.1])))


def test_every_law_returns_its_parameters_from_its_coordinates() -> None:
    for law in catalogue().values():
        start = np.array([p.starts[0] for p in law.parameters])
        assert law.from_coordinates(law.coordinates(start)) == pytest.approx(start)


def test_a_parameter_without_influence_on_the_prediction_keeps_its_value() -> None:
    """As the roll of a base with horizontal joint axes: its slope is rounding error."""
    random = np.random.default_rng(3)
    tilt = Hypothesis((Term("base_tilt", -1),), np.array([0.0, 0.02]))
    jacobian = random.standard_normal((200, 1, 2)) * np.array([1e-7, 1.0])
    residual = 0.01 * jacobian[:, :, 1] + 3e-3 * random.standard_normal((200, 1))
    moved = propose_step(tilt, residual, jacobian, np.ones(1), 1e-4)
    assert moved.theta[0] == 0.0
    assert moved.theta[1] == pytest.approx(0.03, abs=2e-3)
    # With a slope above rounding error, the parameter is fitted.
    rolled = residual - 0.01 * jacobian[:, :, 0] * 1e7
    free = propose_step(tilt, rolled, jacobian * np.array([1e7, 1.0]), np.ones(1), 1e-4)
    assert free.theta[0] == pytest.approx(-0.01, abs=2e-3)


def test_every_law_declares_the_laws_that_it_contains_or_reduces_to() -> None:
    for law in catalogue().values():
        values = {p.name: np.float64(p.starts[0]) for p in law.parameters}
        contained = {*law.special_cases(values), *(e for e in catalogue() if law.holds(e))}
        assert contained <= law.generalizes, law.id
