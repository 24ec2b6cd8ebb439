"""Sensors whose reading is linear in what is true: ``reading = matrix true + bias``.

Least squares on stretches of time. Noise of a sensor is correlated from sample to sample, so the
covariance comes from the sums of whole blocks (Newey, West, 1987, with blocks in place of a
kernel), and intervals from Student's distribution with one degree of freedom less than blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray

BLOCKS = 30
"""Blocks of a covariance: its standard deviations are good to 13 %."""
UNTOLD = 1e-3
"""Part of the largest singular value below which a direction of the true signal was not excited;
the columns are scaled to their own size first."""


@dataclass(frozen=True)
class Linear:
    """A linear sensor, estimated.

    Attributes:
        matrix: (k, m) reading by true signal; rows of directions that were not excited are those of
            the nominal matrix.
        bias: (k,).
        covariance: (k, m + 1, m + 1) for each channel: its row of the matrix, then its bias.
        untold: unit vectors (m + 1,) of the scaled true signal, and the bias, not excited.
        residual: (k,) root mean square of what is not explained.
        blocks: how many the covariance depends on.
    """

    matrix: FloatArray
    bias: FloatArray
    covariance: FloatArray
    untold: tuple[FloatArray, ...]
    residual: FloatArray
    blocks: int

    def measured(self, true: FloatArray) -> FloatArray:
        """(n, k) readings of (n, m) true signals."""
        return np.asarray(true @ self.matrix.T + self.bias)


def fit_linear(
    true: FloatArray, reading: FloatArray, blocks: Sequence[int], nominal: FloatArray
) -> Linear:
    """Least squares of a linear sensor.

    Args:
        true: (n, m) true signals.
        reading: (n, k).
        blocks: (n,) number of the block of each sample, from 0 on.
        nominal: (k, m) matrix that holds where nothing was excited.
    """
    design = np.hstack([true, np.ones((len(true), 1))])
    scale = np.linalg.norm(design, axis=0) / np.sqrt(len(design))
    # A channel of the true signal that is rounding alone is not excited.
    scale[scale < 1e-9 * scale.max()] = np.inf
    left, sizes, right = np.linalg.svd(design / scale, full_matrices=False)
    kept = sizes > UNTOLD * sizes[0]
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
    """Block of each sample of recordings, in their order: about ``BLOCKS`` in all.

    Args:
        samples: of each recording; no block spans two.
    """
    size = max(2, int(np.ceil(sum(samples) / BLOCKS)))
    found: list[int] = []
    first = 0
    for count in samples:
        own = max(1, round(count / size))
        found += (first + np.minimum(np.arange(count) * own // count, own - 1)).tolist()
        first += own
    return found
