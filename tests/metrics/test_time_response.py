"""Step response metrics compared with closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from pytest_twin.metrics.time_response import settling_time, step_metrics, worst_sample


def second_order(t: np.ndarray, omega: float, zeta: float) -> np.ndarray:
    """Unit step response of omega^2 / (s^2 + 2 zeta omega s + omega^2), underdamped."""
    damped = omega * np.sqrt(1.0 - zeta**2)
    return 1.0 - np.exp(-zeta * omega * t) * (
        np.cos(damped * t) + zeta / np.sqrt(1.0 - zeta**2) * np.sin(damped * t)
    )


@given(tau=st.floats(0.02, 0.1), start=st.floats(-3.0, 3.0), change=st.floats(0.1, 5.0))
@settings(max_examples=30, deadline=None)
def test_step_metrics_of_a_first_order_response(tau: float, start: float, change: float) -> None:
    time = np.linspace(0.0, 2.0, 4001)
    found = step_metrics(time, start + change * (1.0 - np.exp(-time / tau)), target=start + change)
    assert found.rise_time == pytest.approx(np.log(9.0) * tau, rel=1e-3)
    assert found.settling_time == pytest.approx(np.log(50.0) * tau, rel=1e-3)
    assert found.overshoot == pytest.approx(0.0, abs=1e-6)
    assert found.final == pytest.approx(start + change, rel=1e-6)
    assert found.steady_state_error == pytest.approx(0.0, abs=1e-6)


@given(zeta=st.floats(0.25, 0.9), omega=st.floats(10.0, 40.0), sign=st.sampled_from([-1.0, 1.0]))
@settings(max_examples=30, deadline=None)
def test_step_metrics_of_a_second_order_response(zeta: float, omega: float, sign: float) -> None:
    time = np.linspace(0.0, 60.0 / omega, 20001)
    found = step_metrics(time, sign * 0.3 * second_order(time, omega, zeta))
    assert found.overshoot == pytest.approx(
        np.exp(-np.pi * zeta / np.sqrt(1.0 - zeta**2)), abs=1e-4
    )
    ten, ninety = (
        brentq(lambda t, y=y: second_order(np.array(t), omega, zeta) - y, 0.0, peak)
        for peak in [np.pi / (omega * np.sqrt(1.0 - zeta**2))]
        for y in (0.1, 0.9)
    )
    assert found.rise_time == pytest.approx(ninety - ten, rel=1e-3)
    dense = np.linspace(0.0, 60.0 / omega, 200_001)
    outside = np.abs(second_order(dense, omega, zeta) - 1.0) > 0.02
    assert found.settling_time == pytest.approx(
        dense[np.flatnonzero(outside)[-1]], abs=5e-3 / omega
    )


def test_steady_state_error_is_a_fraction_of_the_step() -> None:
    time = np.linspace(0.0, 1.0, 1001)
    response = 0.2 + 0.4 * (1.0 - np.exp(-time / 0.05))
    found = step_metrics(time, response, target=0.7)
    assert found.steady_state_error == pytest.approx((0.7 - 0.6) / 0.5, rel=1e-6)


@pytest.mark.parametrize(
    "response",
    [
        lambda t: t,  # a ramp never comes to rest
        lambda t: np.sin(20.0 * t),  # an undamped oscillator never comes to rest
        lambda t: np.zeros_like(t),  # no response
        lambda t: np.where(t > 0.5, np.nan, t),
    ],
)
def test_metrics_of_a_response_without_steady_state_are_none(response) -> None:
    time = np.linspace(0.0, 1.0, 1001)
    found = step_metrics(time, response(time), target=1.0)
    assert found.rise_time is None
    assert found.overshoot is None
    assert found.settling_time is None
    assert found.steady_state_error is None
    assert found.final is None


def test_without_a_target_there_is_no_steady_state_error() -> None:
    time = np.linspace(0.0, 1.0, 1001)
    found = step_metrics(time, 1.0 - np.exp(-time / 0.05))
    assert found.steady_state_error is None
    assert found.rise_time is not None


def test_settling_time_is_that_of_the_slowest_column() -> None:
    time = np.linspace(0.0, 2.0, 2001)
    values = np.column_stack([np.exp(-time / 0.05), np.exp(-time / 0.2)])
    found = settling_time(time, values, np.zeros(2), np.array([0.01, 0.01]))
    assert found == pytest.approx(0.2 * np.log(100.0), rel=1e-4)
    assert settling_time(time, values, np.zeros(2), np.array([0.01, 1e-6])) is None
    assert settling_time(time, values, np.zeros(2), np.array([2.0, 2.0])) == 0.0


def test_a_nan_sample_counts_as_the_worst() -> None:
    time = np.array([0.0, 1.0, 2.0])
    error, at, now, then = worst_sample(time, np.array([0.0, np.nan, 9.0]), np.zeros(3))
    assert np.isnan(error)
    assert np.isnan(now)
    assert (at, then) == (1.0, 0.0)
    assert worst_sample(time, np.array([0.0, -3.0, 1.0]), np.zeros(3))[:2] == (3.0, 1.0)
