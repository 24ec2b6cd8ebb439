"""Fit of sensors that are linear in the true signal: ``reading = matrix true + bias``.

The fit uses least squares. Sensor noise is correlated in time, so the covariance is computed from
the sums over time blocks (Newey, West, 1987, with blocks instead of a kernel). Intervals use
Student's distribution with one degree of freedom less than the number of blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray

BLOCKS = 30
"""Number of blocks of a covariance. Its standard deviations are then accurate to 13 %."""
UNDETERMINED = 1e-3
"""Fraction of the largest singular value below which a direction of the true signal was not
excited. The columns are normalized first."""


@dataclass(frozen=True)
class Linear:
    """Estimated linear sensor.

    Attributes:
        matrix: (k, m) matrix from true signal to reading; in directions that were not excited it is
            the nominal matrix.
        bias: (k,) bias.
        covariance: (k, m + 1, m + 1) covariance of each channel: its row of the matrix, then its
            bias.
        undetermined: (m + 1,) unit vectors of directions of the normalized true signal and bias
            that were not excited.
        residual: (k,) RMS residual.
        blocks: number of blocks of the covariance.
    """

    matrix: FloatArray
    bias: FloatArray
    covariance: FloatArray
    undetermined: tuple[FloatArray, ...]
    residual: FloatArray
    blocks: int

    def measured(self, true: FloatArray) -> FloatArray:
        """(n, k) readings of (n, m) true signals."""
        return np.asarray(true @ self.matrix.T + self.bias)


def fit_linear(
    true: FloatArray, reading: FloatArray, blocks: Sequence[int], nominal: FloatArray
) -> Linear:
    """Fit a linear sensor by least squares.

    Args:
        true: (n, m) true signals.
        reading: (n, k) readings.
        blocks: (n,) index of the block of each sample, from 0.
        nominal: (k, m) matrix that is used in directions without excitation.
    """
    design = np.hstack([true, np.ones((len(true), 1))])
    scale = np.linalg.norm(design, axis=0) / np.sqrt(len(design))
    # A channel of the true signal with rounding errors only is not excited.
    scale[scale < 1e-9 * scale.max()] = np.inf
    left, sizes, right = np.linalg.svd(design / scale, full_matrices=False)
    kept = sizes > UNDETERMINED * sizes[0]
    start = np.vstack([nominal.T, np.zeros((1, len(nominal)))])
    inverse = (right[kept].T / sizes[kept]) @ left[:, kept].T
    scale = np.where(np.isfinite(scale), scale, 1.0)
    step = (inverse @ (reading - design @ start)) / scale[:, None]
    found = start + step
    errors = reading - design @ found
    number = np.array(blocks)
    count = int(number.max()) + 1
    bread = inverse / scale[:, None]
    covariance = np.empty((reading.shape[1], design.shape[1], design.shape[1]))
    for channel in range(reading.shape[1]):
        scores = bread * errors[:, channel]
        sums = np.stack([scores[:, number == block].sum(axis=1) for block in range(count)])
        covariance[channel] = count / (count - 1) * sums.T @ sums
    return Linear(
        found[:-1].T,
        found[-1],
        covariance,
        tuple(right[~kept]),
        np.sqrt(np.mean(errors**2, axis=0)),
        count,
    )


def in_blocks(samples: Sequence[int]) -> list[int]:
    """Return the block of each sample of recordings, with about ``BLOCKS`` blocks in total.

    Args:
        samples: number of samples of each recording; no block spans two recordings.
    """
    size = max(2, int(np.ceil(sum(samples) / BLOCKS)))
    found: list[int] = []
    first = 0
    for count in samples:
        own = max(1, round(count / size))
        found += (first + np.minimum(np.arange(count) * own // count, own - 1)).tolist()
        first += own
    return found
