"""Uncertainty of the earlier model in the intervals of changes."""

from __future__ import annotations

import numpy as np

from pytest_twin.changes.carried import _within_bounds


def test_an_undetermined_parameter_is_as_uncertain_as_its_bounds() -> None:
    covariance = np.array([[0.04, 0.01, np.nan], [0.01, 9.0, np.nan], [np.nan, np.nan, np.inf]])
    inside = _within_bounds(covariance, np.array([1.0, 1.5, 2.0]))
    np.testing.assert_allclose(np.sqrt(np.diag(inside)), [0.2, 1.5, 2.0])
    np.testing.assert_allclose(inside[0], [0.04, 0.005, 0.0])
