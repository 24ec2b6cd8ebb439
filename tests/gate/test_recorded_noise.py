"""Rounding errors below 1e-12 SI units are recorded as zero."""

from __future__ import annotations

import numpy as np

from pytest_twin.gate.noise import without_rounding_errors
from pytest_twin.trace import Trace


def test_rounding_errors_become_zero_and_results_keep_all_digits() -> None:
    expected = {"onset": [1.5612869235984334e-19, -3e-17, 1e-9], "rise_time": None, "count": 3}
    trace = Trace(("time", "s"), np.array([0.0, 1.0]), {"a": ("rad", np.array([-1e-18, 0.1]))})
    values, series = without_rounding_errors(expected, trace)
    assert values == {"onset": [0.0, 0.0, 1e-9], "rise_time": None, "count": 3}
    assert series is not None
    assert series.columns["a"][1].tolist() == [0.0, 0.1]


def test_values_without_a_trace_are_cleaned_too() -> None:
    assert without_rounding_errors({"joints": {"elbow": {"mean": 2e-14}}}, None) == (
        {"joints": {"elbow": {"mean": 0.0}}},
        None,
    )
