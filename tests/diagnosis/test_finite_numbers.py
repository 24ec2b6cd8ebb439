"""No number of a diagnosis is NaN or infinite, which JSON cannot represent."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_twin.diagnosis.findings import build_estimate
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import Parameter

PARAMETERS = [p for e in catalogue().values() for p in e.parameters]
RECIPROCAL = [p for p in PARAMETERS if p.reciprocal_of is not None]


def test_the_catalogue_has_at_least_three_parameters_that_are_reported_as_reciprocals() -> None:
    assert len(RECIPROCAL) >= 3


@given(
    p=st.sampled_from(PARAMETERS),
    at=st.floats(0.0, 1.0),
    half=st.floats(0.0, 1e6) | st.just(math.nan) | st.just(math.inf),
    scale=st.floats(1e-6, 1e6),
)
@settings(max_examples=300, deadline=None)
def test_an_estimate_is_finite_and_inside_its_interval(
    p: Parameter, at: float, half: float, scale: float
) -> None:
    theta = p.lower + at * (p.upper - p.lower)
    found = build_estimate(p, theta, half, scale, "1")
    json.dumps([found.value, found.low, found.high], allow_nan=False)
    slack = 1e-9 * max(abs(found.low), abs(found.high))
    assert found.low - slack <= found.value <= found.high + slack


@pytest.mark.parametrize("p", RECIPROCAL, ids=lambda p: p.name)
def test_the_reciprocal_of_zero_is_reported_as_a_large_finite_value(p: Parameter) -> None:
    scale = 0.5
    nearest = 1.0 / (p.upper * scale)
    found = build_estimate(p, 0.0, 0.0, scale, "1")
    assert found.value > 1e5 * nearest
    # An interval around zero gives a lower bound of the reciprocal.
    bounded = build_estimate(p, 0.0, 0.1 * p.upper, scale, "1")
    assert bounded.low == pytest.approx(10.0 * nearest)
    assert bounded.low < bounded.value < bounded.high


def test_a_reciprocal_away_from_zero_has_the_reciprocal_interval() -> None:
    p = RECIPROCAL[0]
    theta = 0.5 * p.upper
    found = build_estimate(p, theta, 0.1 * theta, 2.0, "1")
    assert found.value == pytest.approx(1.0 / (2.0 * theta))
    assert (found.low, found.high) == pytest.approx(
        (1.0 / (2.2 * theta), 1.0 / (1.8 * theta)), rel=1e-9
    )
