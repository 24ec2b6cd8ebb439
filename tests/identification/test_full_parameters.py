"""Coordinates of a link in which every value is a physically possible body."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.identification.full_parameters import LinkInertia
from pytest_twin.realization.inverse_dynamics import INERTIAL

STATED = {"Ixx": 0.03, "Ixy": 0.002, "Ixz": -0.001, "Iyy": 0.14, "Iyz": 0.0005, "Izz": 0.13,
              "mx": 0.5, "my": 0.05, "mz": -0.03, "m": 2.5}  # fmt: skip


def link() -> LinkInertia:
    return LinkInertia(0, np.array([STATED[name] for name in INERTIAL]))


def test_zero_deviation_gives_the_stated_parameters() -> None:
    found = dict(zip(INERTIAL, link().parameters(np.zeros(10)), strict=True))
    assert found == pytest.approx(STATED)


def test_the_derivative_agrees_with_finite_differences() -> None:
    random = np.random.default_rng(2)
    for x in 0.5 * random.standard_normal((5, 10)):
        step = 1e-6
        ends = [
            (link().parameters(x + step * e), link().parameters(x - step * e)) for e in np.eye(10)
        ]
        differences = np.array([(up - down) / (2.0 * step) for up, down in ends]).T
        np.testing.assert_allclose(link().slope(x), differences, rtol=1e-6, atol=1e-8)


def test_every_deviation_gives_a_physically_possible_body() -> None:
    random = np.random.default_rng(3)
    for x in 3.0 * random.standard_normal((50, 10)):
        own = dict(zip(INERTIAL, link().parameters(x), strict=True))
        com = np.array([own["mx"], own["my"], own["mz"]]) / own["m"]
        about_origin = np.array([
            [own["Ixx"], own["Ixy"], own["Ixz"]],
            [own["Ixy"], own["Iyy"], own["Iyz"]],
            [own["Ixz"], own["Iyz"], own["Izz"]],
        ])  # fmt: skip
        about_com = about_origin - own["m"] * (com @ com * np.eye(3) - np.outer(com, com))
        small, middle, large = np.linalg.eigvalsh(about_com)
        assert own["m"] > 0
        assert small + middle > large * (1.0 - 1e-6)
