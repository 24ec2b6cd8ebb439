"""Residuals in multiples of the noise floor, and effects in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.estimation.hypothesis import Hypothesis, Term


def in_noise_floors(residual: FloatArray, floor: FloatArray) -> FloatArray:
    """(signals,) RMS residual in noise floors; infinite where a simulation diverged."""
    with np.errstate(over="ignore"):
        level: FloatArray = np.sqrt(np.mean(residual**2, axis=0)) / floor
    return np.where(np.isfinite(level), level, np.inf)


def levels_on(
    problem: Problem, hypotheses: Sequence[Hypothesis], segments: NDArray[np.int64]
) -> list[FloatArray]:
    """(signals,) residual of each hypothesis on some recordings, in noise floors."""
    residuals = problem.residuals(hypotheses, segments)
    return [in_noise_floors(residual, problem.signal_floor) for residual in residuals]


def label(problem: Problem, term: Term) -> str:
    """Effect and joint in words."""
    joint = joint_name(problem, term)
    return term.effect if joint is None else f"{term.effect} at {joint}"


def joint_name(problem: Problem, term: Term) -> str | None:
    """Joint of an effect; None for an effect of the whole robot."""
    return None if term.joint < 0 else problem.joints[term.joint]
