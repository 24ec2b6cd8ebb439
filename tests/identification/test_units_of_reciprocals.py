"""A parameter that is fitted as a reciprocal is stated with the unit of the reciprocal."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import reciprocal_unit
from pytest_twin.identification.simulation import document


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


def stated(effect: str, theta: list[float], monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """``parameters`` of ``identification.json`` for one effect at the elbow, all scales 2."""
    monkeypatch.setattr(document, "impossible", lambda problem, hypothesis: {})
    term = Term(effect, 0)
    hypothesis = Hypothesis((term,), np.array(theta))
    layout = SimpleNamespace(slides=np.array([False]), servo=np.array(["position"]))
    problem = SimpleNamespace(
        joints=("elbow",), scales=SimpleNamespace(value=lambda parameter, joint: 2.0),
        simulator=SimpleNamespace(layout=layout), held_out=[],
    )  # fmt: skip
    spread = SimpleNamespace(half_width=np.full(len(theta), 0.1), joint=0.01 * np.eye(len(theta)))
    error = SimpleNamespace(before=1.0, after=0.5, unit="rad", floor=0.1)
    result = SimpleNamespace(
        prepared=SimpleNamespace(problem=problem), hypothesis=hypothesis, spread=spread,
        stage_of={term: "drive"}, errors={"elbow": error}, stages=(), notes=(),
    )  # fmt: skip
    found = document.simulation_document(result)
    assert found["covariance"]["names"] == list(found["parameters"])
    return found["parameters"]


def test_an_identified_limit_is_named_as_a_reciprocal_in_its_unit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Half of the scale 2: an inverse limit of 1 per N*m."""
    (one,) = stated("torque_saturation", [0.5], monkeypatch).items()
    assert one[0] == "elbow.torque_saturation.inverse_limit"
    assert (one[1]["value"], one[1]["unit"]) == (1.0, "1/(N*m)")


def test_an_identified_roll_off_has_a_reciprocal_and_a_damping(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = stated("torque_rolloff", [0.5, 0.1], monkeypatch)
    assert {name: one["unit"] for name, one in found.items()} == {
        "elbow.torque_rolloff.inverse_knee": "1/(N*m)",
        "elbow.torque_rolloff.back_emf": "N*m*s/rad",
    }
    (name,) = stated("viscous_friction", [0.1], monkeypatch)
    assert name == "elbow.viscous_friction"
