"""Predict the covariance of base parameters from a planned motion and the effort noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Prediction:
    """Predicted covariance of a motion.

    Attributes:
        covariance: (b, b) covariance of the base parameters, in their units; ``inf`` on the
            diagonal for parameters that the motion does not excite.
        undetermined: (b,) True for parameters that the motion does not determine.
        condition: condition number of the weighted regressor with unit columns.
    """

    covariance: FloatArray
    undetermined: NDArray[np.bool_]
    condition: float

    @property
    def std(self) -> FloatArray:
        """(b,) standard deviations."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


LARGEST_CONDITION = 1e7
"""Largest ratio of singular values of the weighted regressor with unit columns. Directions with
smaller singular values are undetermined: an error of 1e-7 in the geometry would change their value
completely."""


def predicted_covariance(matrix: FloatArray, effort_std: FloatArray) -> Prediction:
    """Predict the covariance of weighted least squares: (sum W^T diag(1 / std^2) W)^-1.

    Args:
        matrix: (n, joints, b) base columns at n instants of the motion, one for each independent
            sample of the noise (after decimation to its bandwidth).
        effort_std: (joints,) standard deviation of the effort's noise at one sample, N*m or N.
    """
    weighted = (np.asarray(matrix) / np.asarray(effort_std)[:, None]).reshape(
        -1, np.shape(matrix)[-1]
    )
    sizes = np.linalg.norm(weighted, axis=0)
    moved = sizes > sizes.max(initial=0.0) / LARGEST_CONDITION
    scaled = weighted[:, moved] / sizes[moved]
    # The triangle has the same singular values and directions.
    triangle = np.linalg.qr(scaled, mode="r")
    _, singular, directions = np.linalg.svd(triangle, full_matrices=False)
    if not len(singular):
        count = weighted.shape[1]
        open_ = np.ones(count, dtype=bool)
        return Prediction(np.diag(np.full(count, np.inf)), open_, np.inf)
    good = singular > singular[0] / LARGEST_CONDITION
    # A parameter is undetermined if it has a component in an undetermined direction.
    part = np.sqrt(np.sum(directions[~good] ** 2, axis=0))
    undetermined = ~moved
    undetermined[np.flatnonzero(moved)[part > 1e-3]] = True
    inverse = (directions[good].T / singular[good] ** 2) @ directions[good]
    covariance = np.zeros((weighted.shape[1], weighted.shape[1]))
    at = np.ix_(moved, moved)
    covariance[at] = inverse / np.outer(sizes[moved], sizes[moved])
    covariance[undetermined] = 0.0
    covariance[:, undetermined] = 0.0
    covariance[undetermined, undetermined] = np.inf
    return Prediction(covariance, undetermined, float(singular[0] / max(singular[-1], 1e-300)))
