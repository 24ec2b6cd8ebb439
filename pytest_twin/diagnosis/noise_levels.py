"""Residuals in multiples of the noise floor, and effects in words."""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.estimation.hypothesis import Term


def in_noise_floors(residual: FloatArray, floor: FloatArray) -> FloatArray:
    """(signals,) RMS residual in noise floors; infinite where a simulation diverged."""
    with np.errstate(over="ignore"):
        level: FloatArray = np.sqrt(np.mean(residual**2, axis=0)) / floor
    return np.where(np.isfinite(level), level, np.inf)


def excess(squares: FloatArray) -> float:
    """Sum of squared levels beyond the noise; ``squares`` are in squared noise floors."""
    return float(np.maximum(squares - 1.0, 0.0).sum())


def label(problem: Problem, term: Term) -> str:
    """Effect and joint in words."""
    joint = joint_name(problem, term)
    return term.effect if joint is None else f"{term.effect} at {joint}"


def joint_name(problem: Problem, term: Term) -> str | None:
    """Joint of an effect; None for an effect of the whole robot."""
    return None if term.joint < 0 else problem.joints[term.joint]
