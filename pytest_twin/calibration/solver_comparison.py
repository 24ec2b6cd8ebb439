"""Compare the held-out errors of the algebraic solvers with those of the least squares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import wilcoxon

from pytest_twin.arrays import FloatArray

CHANCE = 0.01
"""Significance level at which a solver is better (Bonferroni over the solvers)."""

LEAST_SQUARES = "least_squares"


@dataclass(frozen=True)
class BetterSolver:
    """An algebraic solver with a smaller held-out error than the least squares.

    Attributes:
        is_beyond_chance: whether the difference is significant.
    """

    name: str
    is_beyond_chance: bool
    words: str


def better_solver(distances: Mapping[str, FloatArray]) -> BetterSolver | None:
    """Return the solver with the smallest held-out error; None if it is the least squares.

    With few observations, one of seven solvers has a smaller error in a third of all calibrations,
    although its transform has a larger one. A paired test over the observations (Wilcoxon) decides.

    Args:
        distances: solver -> (n,) held-out position errors of the same observations, m.
    """
    # Of a coordinate, as all other errors of a calibration.
    sizes = {
        name: float(np.sqrt(np.mean(one**2) / 3.0)) for name, one in distances.items() if len(one)
    }
    if not sizes or LEAST_SQUARES not in sizes:
        return None
    name = min(sizes, key=lambda one: sizes[one])
    difference = distances[name] - distances[LEAST_SQUARES]
    if name == LEAST_SQUARES or not (difference < 0.0).any():
        return None
    chance = float(wilcoxon(difference, alternative="less").pvalue) * (len(sizes) - 1)
    words = (
        f"{name} has a smaller held-out error than least squares, {1e3 * sizes[name]:.3g} against "
        f"{1e3 * sizes[LEAST_SQUARES]:.3g} mm; {int((difference < 0.0).sum())} of "
        f"{len(difference)} observations are nearer with it"
    )
    if chance < CHANCE:
        return BetterSolver(
            name,
            is_beyond_chance=True,
            words=f"{words}, which is beyond chance (significance {chance:.2g}): positions and "
            f"angles do not have the noise that least squares assumes. solvers.{name} has its "
            "transforms",
        )
    return BetterSolver(
        name,
        is_beyond_chance=False,
        words=f"{words}, which is within chance: least squares, which weighs positions and angles "
        "by their noise, is kept",
    )
