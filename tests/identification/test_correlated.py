"""Strongly correlated parameters are named in pairs."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.estimation.covariance import correlated_pairs


def test_pairs_beyond_0_9_are_named_the_strongest_first() -> None:
    correlation = np.array([[1.0, -0.95, 0.5], [-0.95, 1.0, 0.98], [0.5, 0.98, 1.0]])
    size = np.array([2.0, 0.1, 30.0])
    found = correlated_pairs(["a.fv", "a.fs", "b.Ia"], correlation * np.outer(size, size))
    assert [one["pair"] for one in found] == [["a.fs", "b.Ia"], ["a.fv", "a.fs"]]
    assert [one["correlation"] for one in found] == pytest.approx([0.98, -0.95])


def test_a_parameter_without_variance_is_in_no_pair() -> None:
    assert correlated_pairs(["a", "b"], np.array([[1.0, 0.0], [0.0, 0.0]])) == []
