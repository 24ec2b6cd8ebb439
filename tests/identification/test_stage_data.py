"""Share of each recording in the information on a stage's parameters."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.identification.stages import shares


def test_shares_are_means_over_the_parameters_and_sum_to_one() -> None:
    information = np.array([[3.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
    found = shares(["slow.mcap", "quick.mcap", "quick.mcap"], information)
    assert found == pytest.approx({"slow.mcap": 0.625, "quick.mcap": 0.375})


def test_parameters_without_information_do_not_count() -> None:
    assert shares(["a", "b"], np.array([[1.0, 0.0], [3.0, 0.0]])) == {"a": 0.25, "b": 0.75}
    assert shares(["a"], np.zeros((1, 2))) == {}
