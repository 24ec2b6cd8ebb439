"""Fit of sensors that are linear in the true signal: ``reading = matrix true + bias``.

The fit uses least squares. Sensor noise is correlated in time, so the covariance is computed from
the sums over time blocks (Newey, West, 1987, with blocks instead of a kernel). A few blocks with
much excitation determine most of a parameter, so its variance has fewer degrees of freedom than
there are blocks (Bell, McCaffrey, Survey Methodology 28, 2002).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray

BLOCKS = 30
"""Number of blocks of a covariance. Its standard deviations are then accurate to 13 %."""
_LEAST_LEFT = 0.01
"""Smallest share of a direction that other blocks determine, to which its residuals are scaled. A
direction that only one block shows has no residual in it."""
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
        freedom: (m + 1,) degrees of freedom of the variances, for Student's distribution.
    """

    matrix: FloatArray
    bias: FloatArray
    covariance: FloatArray
    undetermined: tuple[FloatArray, ...]
    residual: FloatArray
    freedom: FloatArray

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
    excited = left[:, kept]
    to_parameters = (right[kept].T / sizes[kept]) / scale[:, None]
    leverages = [_Leverage.of(excited[number == block]) for block in range(count)]
    sums = np.empty((count, reading.shape[1], design.shape[1]))
    for block, one in enumerate(leverages):
        rows = number == block
        sums[block] = (to_parameters @ one.without_fit_bias(excited[rows].T @ errors[rows])).T
    covariance = np.einsum("bci,bcj->cij", sums, sums)
    return Linear(
        found[:-1].T,
        found[-1],
        covariance,
        tuple(right[~kept]),
        np.sqrt(np.mean(errors**2, axis=0)),
        _freedom(leverages, to_parameters),
    )


@dataclass(frozen=True)
class _Leverage:
    """Leverage ``H = U U^T`` of a block's rows ``U`` of an orthonormal basis of the design.

    Attributes:
        shares: (r,) eigenvalues of ``U^T U``: how much of a direction the block determines.
        axes: (r, r) eigenvectors.
    """

    shares: FloatArray
    axes: FloatArray

    @classmethod
    def of(cls, rows: FloatArray) -> _Leverage:
        """The leverage of (n, r) rows."""
        shares, axes = np.linalg.eigh(rows.T @ rows)
        return cls(shares.clip(0.0, 1.0 - _LEAST_LEFT), axes)

    def without_fit_bias(self, sums: FloatArray) -> FloatArray:
        """(r, k) sums ``U^T e`` of residuals, as large as those of the noise.

        A fit follows the noise of each block in part. The factor ``(1 - H)^(-1/2)`` removes the
        bias: ``U^T (1 - H)^(-1/2) e = (1 - U^T U)^(-1/2) U^T e``.
        """
        return np.asarray((self.axes / np.sqrt(1.0 - self.shares)) @ self.axes.T @ sums)


def _freedom(leverages: Sequence[_Leverage], to_parameters: FloatArray) -> FloatArray:
    """(p,) degrees of freedom of the variances, by Satterthwaite's approximation.

    With white noise the variance of a parameter is a quadratic form of it, with the matrix ``D - V
    V^T`` over the blocks. The squared trace over the trace of the square is the approximation.

    Args:
        leverages: leverage of each block.
        to_parameters: (p, r) matrix from the basis of the design to the parameters.
    """
    found = np.empty(len(to_parameters))
    for at, row in enumerate(to_parameters):
        parts = [(one, one.axes.T @ row) for one in leverages]
        own = [float(np.sum(x**2 * one.shares / (1.0 - one.shares))) for one, x in parts]
        across = np.stack(
            [one.axes @ (one.shares / np.sqrt(1.0 - one.shares) * x) for one, x in parts]
        )
        form = np.diag(own) - across @ across.T
        square = float(np.sum(form**2))
        found[at] = float(np.trace(form)) ** 2 / square if square > 0.0 else 1.0
    return np.maximum(found, 1.0)


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
