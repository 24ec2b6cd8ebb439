"""Parameters that the recordings do not determine keep their values in a covariance."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from pytest_twin.effects import catalogue
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.identification.simulation.document import parameters_with_covariance

COULOMB, EXCESS, VELOCITY = (
    f"elbow.stribeck_friction.{name}"
    for name in ("coulomb", "stiction_excess", "stribeck_velocity")
)


def stated(joint: np.ndarray) -> tuple[dict, np.ndarray]:
    """Parameters and covariance of Stribeck friction at the elbow, with all scales 2."""
    term = Term("stribeck_friction", 0)
    layout = SimpleNamespace(slides=np.array([False]), servo=np.array(["position"]))
    problem = SimpleNamespace(
        joints=("elbow",), scales=SimpleNamespace(value=lambda parameter, joint: 2.0),
        simulator=SimpleNamespace(layout=layout),
    )  # fmt: skip
    result = SimpleNamespace(
        prepared=SimpleNamespace(problem=problem),
        spread=SimpleNamespace(
            half_width=1.96 * np.sqrt(np.diag(joint)), conservative_covariance=joint
        ),
        stage_of={term: "friction"},
        hypothesis=Hypothesis((term,), np.array([0.3, 0.1, 0.2])),
    )
    return parameters_with_covariance(result)


def covariance(deviation: list[float], correlation: float) -> np.ndarray:
    """Covariance with a correlation between the first and the last of three parameters."""
    matrix = np.eye(3)
    matrix[0, 2] = matrix[2, 0] = correlation
    return matrix * np.outer(deviation, deviation)


def test_an_interval_that_contains_all_values_of_the_law_is_the_range_of_the_law() -> None:
    parameters, found = stated(covariance([0.05, 0.02, 40.0], 0.8))
    (law,) = (
        p for p in catalogue()["stribeck_friction"].parameters if p.name == "stribeck_velocity"
    )
    assert parameters[VELOCITY]["ci95"] == pytest.approx([2.0 * law.lower, 2.0 * law.upper])
    assert not found[2].any()
    assert not found[:, 2].any()


def test_the_others_have_their_covariance_at_its_value() -> None:
    """With a correlation of 0.8, 60 % of the standard deviation are left."""
    parameters, found = stated(covariance([0.05, 0.02, 40.0], 0.8))
    assert np.sqrt(np.diag(found)) == pytest.approx([2.0 * 0.6 * 0.05, 2.0 * 0.02, 0.0])
    half = np.diff(parameters[COULOMB]["ci95"])[0] / 2.0
    assert half == pytest.approx(2.0 * 1.96 * 0.05)
    assert parameters[EXCESS]["value"] == pytest.approx(0.2)


def test_a_determined_parameter_keeps_interval_and_correlation() -> None:
    joint = covariance([0.05, 0.02, 0.06], 0.8)
    parameters, found = stated(joint)
    assert found == pytest.approx(4.0 * joint)
    assert parameters[VELOCITY]["ci95"] == pytest.approx([0.4 - 0.2352, 0.4 + 0.2352])


@pytest.mark.parametrize("deviation", [np.inf, np.nan])
def test_an_infinite_interval_leaves_the_covariance_of_the_others(deviation: float) -> None:
    joint = covariance([0.05, 0.02, 1.0], 0.0)
    joint[2] = joint[:, 2] = deviation
    _, found = stated(joint)
    assert np.sqrt(np.diag(found)) == pytest.approx([0.1, 0.04, 0.0])
