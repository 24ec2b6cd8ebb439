"""Block bootstrap of a linear fit: check its covariance without a noise model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.estimation.covariance import (
    ENOUGH_RECORDINGS,
    block_of,
    bootstrap_deviations,
)
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.least_squares import LinearProblem, Solution, weight_rows

_WIDER = 1.5
"""Ratio of bootstrap to stated standard deviation above which the report mentions it."""


@dataclass(frozen=True)
class Bootstrap:
    """Result of the block bootstrap.

    Attributes:
        blocks: number of blocks.
        recordings: True if blocks are whole recordings, False for parts of recordings.
        interval: (b, 2) 95 % interval about the estimate.
        wider: (b,) True where the standard deviation is at least 1.5 times the stated one.
    """

    blocks: int
    recordings: bool
    interval: FloatArray
    wider: NDArray[np.bool_]


def bootstrap(
    problem: LinearProblem, fitted: Solution, left: FloatArray | None = None
) -> Bootstrap:
    """Repeat the fit with random weights of the blocks and the final weights of the rows.

    Residuals may be correlated within a block in any way (Künsch, Annals of Statistics 17, 1989).
    Blocks get exponential weights (Rubin, Annals of Statistics 9, 1981), so that a parameter that
    only one block excites stays determined.

    Args:
        problem, fitted: problem and result of the fit.
        left: (n, joints, b) instrument of an instrumental-variable estimate.
    """
    deviation = bootstrap_deviations(*normal_equations(problem, fitted.weight, left))
    half = Z95 * deviation[:, None] * np.array([-1.0, 1.0])
    whole = len(problem.lengths) >= ENOUGH_RECORDINGS
    return Bootstrap(
        blocks=len(problem.lengths) if whole else len(np.unique(block_of(problem.lengths))),
        recordings=whole,
        interval=fitted.values[:, None] + half,
        wider=deviation > _WIDER * fitted.std,
    )


def normal_equations(
    problem: LinearProblem, weight: FloatArray, left: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """(blocks, b, b) sums of Z^T W and (blocks, b) sums of Z^T y over each block.

    Args:
        problem: rows and columns.
        weight: (n, joints) reciprocal standard deviations of the rows.
        left: Z, (n, joints, b); W itself by default.
    """
    owner = block_of(problem.lengths)
    matrices, rights = [], []
    for k in range(int(owner.max()) + 1):
        mine = owner == k
        w = weight_rows(problem.matrix[mine], weight[mine])
        z = w if left is None else weight_rows(left[mine], weight[mine])
        matrices.append(z.T @ w)
        rights.append(z.T @ (problem.effort[mine] * weight[mine]).ravel())
    return np.array(matrices), np.array(rights)
