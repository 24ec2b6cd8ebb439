"""Curves of forces outside the catalogue: the known effect of the same shape, and words."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from pytest_twin.diagnosis.unnamed_law.shape import Curve, describe_curve, matching_effect
from pytest_twin.effects.unnamed_law import POSITION, SPEED, VELOCITY, Variable

KNOTS = np.linspace(-1.0, 1.0, 41)


def curve(
    of: Callable[[np.ndarray], np.ndarray],
    variable: Variable = POSITION,
    *,
    knots: np.ndarray = KNOTS,
    is_friction: bool = False,
) -> Curve:
    """A curve that is known to 1 % of a force of 1 N m at all knots."""
    return Curve(
        variable=variable,
        is_friction=is_friction,
        units=("rad" if variable is POSITION else "rad/s", "N*m"),
        knots=knots,
        values=of(knots),
        half_width=np.full(len(knots), 0.01),
        occupancy=np.full(len(knots), 1.0 / len(knots)),
        valid=(float(knots[0]), float(knots[-1])),
    )


def bumps(*places: tuple[float, float]) -> Callable[[np.ndarray], np.ndarray]:
    """Forces near places, of given heights in N m."""
    return lambda q: sum(
        (height * np.exp(-(((q - at) / 0.06) ** 2)) for at, height in places), np.zeros_like(q)
    )


@pytest.mark.parametrize(
    ("given", "effect"),
    [
        (curve(lambda q: 0.3 - 2.0 * q), "joint_spring"),
        (curve(lambda v: -0.5 * v, VELOCITY), "viscous_friction"),
        (curve(lambda v: -0.5 * np.sign(v), VELOCITY), "coulomb_friction"),
        (curve(lambda v: -0.5 * v * np.abs(v), VELOCITY), "quadratic_drag"),
        (curve(lambda v: 0.2 - 0.5 * np.sign(v), VELOCITY), "asymmetric_friction"),
        (curve(lambda s: 0.5 + 0.0 * s, SPEED, is_friction=True), "coulomb_friction"),
        (curve(lambda q: np.sin(10.0 * q + 0.4)), "cogging"),
        (curve(bumps((0.3, 1.0))), None),
    ],
)
def test_a_curve_with_the_shape_of_a_known_effect_is_recognized(
    given: Curve, effect: str | None
) -> None:
    assert matching_effect(given, turns=True) == effect


def test_less_than_one_and_a_half_periods_are_not_periodic() -> None:
    once = curve(lambda q: np.sin(np.pi * q), knots=np.linspace(-1.0, 1.0, 41))
    assert matching_effect(once, turns=True) is None


def test_a_sliding_joint_has_no_cogging() -> None:
    assert matching_effect(curve(lambda q: np.sin(10.0 * q)), turns=False) is None


def test_the_three_strongest_parts_are_described_in_their_order() -> None:
    text = describe_curve(curve(bumps((-0.6, 0.8), (-0.2, 0.5), (0.2, 1.0), (0.6, 0.6))))
    assert text.split(", ") == [
        "0.8 N*m in the positive direction within 0.05 rad of -0.6 rad (position)",
        "1 N*m in the positive direction within 0.05 rad of 0.2 rad (position)",
        # One knot: half the distance to its neighbours.
        "0.6 N*m in the positive direction within 0.025 rad of 0.6 rad (position)",
    ]


def test_parts_below_three_tenths_of_the_peak_are_left_out() -> None:
    text = describe_curve(curve(bumps((-0.5, 0.2), (0.5, 1.0))))
    assert text == "1 N*m in the positive direction within 0.05 rad of 0.5 rad (position)"
