"""A parameter that is fitted as a reciprocal is stated with the unit of the reciprocal."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pytest_twin.effects import catalogue
from pytest_twin.effects.base import reciprocal_unit
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.identification.simulation.document import parameters_with_covariance


@pytest.mark.parametrize(
    ("unit", "expected"),
    [("N*m", "1/(N*m)"), ("N", "1/N"), ("s", "1/s"), ("rad/s", "s/rad"),
     ("N*m/rad", "rad/(N*m)"), ("N/m", "m/N"), ("N*m/s", "s/(N*m)")],
)  # fmt: skip
def test_the_unit_of_a_reciprocal(unit: str, expected: str) -> None:
    assert reciprocal_unit(unit) == expected


def test_every_reciprocal_of_the_catalogue_has_another_unit_than_its_reported_value() -> None:
    reciprocals = [
        p for effect in catalogue().values() for p in effect.parameters if p.reciprocal_of
    ]
    assert len(reciprocals) >= 9
    for one in reciprocals:
        for kind in ("hinge", "slide"):
            assert one.fitted_unit(kind) == reciprocal_unit(one.unit(kind))


def stated(effect: str, theta: list[float]) -> dict[str, Any]:
    """Parameters of one effect at the elbow, for an estimate with all scales 2."""
    term = Term(effect, 0)
    layout = SimpleNamespace(slides=np.array([False]), servo=np.array(["position"]))
    problem = SimpleNamespace(
        joints=("elbow",), scales=SimpleNamespace(value=lambda parameter, joint: 2.0),
        simulator=SimpleNamespace(layout=layout),
    )  # fmt: skip
    spread = SimpleNamespace(
        half_width=np.full(len(theta), 0.1), conservative_covariance=0.01 * np.eye(len(theta))
    )
    result = SimpleNamespace(
        prepared=SimpleNamespace(problem=problem), spread=spread, stage_of={term: "drive"},
        hypothesis=Hypothesis((term,), np.array(theta)),
    )  # fmt: skip
    parameters, covariance = parameters_with_covariance(result)
    assert covariance == pytest.approx(0.04 * np.eye(len(parameters)))
    return parameters


def test_an_identified_limit_is_named_as_a_reciprocal_in_its_unit() -> None:
    """Half of the scale 2: an inverse limit of 1 per N*m."""
    (one,) = stated("torque_saturation", [0.5]).items()
    assert one[0] == "elbow.torque_saturation.inverse_limit"
    assert (one[1]["value"], one[1]["unit"]) == (1.0, "1/(N*m)")


def test_an_identified_roll_off_has_a_reciprocal_and_a_damping() -> None:
    found = stated("torque_rolloff", [0.5, 0.1])
    assert {name: one["unit"] for name, one in found.items()} == {
        "elbow.torque_rolloff.inverse_knee": "1/(N*m)",
        "elbow.torque_rolloff.back_emf": "N*m*s/rad",
    }
    (name,) = stated("viscous_friction", [0.1])
    assert name == "elbow.viscous_friction"
