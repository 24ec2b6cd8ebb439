"""Curves of forces outside the catalogue, in words."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pytest_twin.diagnosis.unnamed_law.shape import Curve, describe_curve
from pytest_twin.effects.unnamed_law import POSITION, Variable

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
