"""Normal equations of a bundle adjustment in blocks, solved with the larger family eliminated.

The matrix couples each target pose only with the corners that its image shows, and no pose with
another one. Either all poses or all corners are therefore eliminated block by block (Schur
complement; Triggs et al.: Bundle adjustment, a modern synthesis, 2000, section 6.1). The cost is
linear in the number of the eliminated blocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pytest_twin.arrays import FloatArray


@dataclass(frozen=True)
class BlockMatrix:
    """Symmetric positive definite matrix over shared unknowns, target poses and corners.

    Attributes:
        shared: (g, g).
        poses: (n, 6, 6) diagonal blocks of the target poses.
        corners: (c, 3, 3) diagonal blocks of the corners on the board; c is 0 if they are fixed.
        shared_poses: (g, 6 n).
        shared_corners: (g, 3 c).
        poses_corners: (6 n, 3 c).
    """

    shared: FloatArray
    poses: FloatArray
    corners: FloatArray
    shared_poses: FloatArray
    shared_corners: FloatArray
    poses_corners: FloatArray


@dataclass(frozen=True)
class Step:
    """A vector over the unknowns of a :class:`BlockMatrix`.

    Attributes:
        shared: (g,).
        poses: (n, 6).
        corners: (c, 3).
    """

    shared: FloatArray
    poses: FloatArray
    corners: FloatArray


@dataclass(frozen=True)
class Covariance:
    """Blocks of the inverse of a :class:`BlockMatrix`.

    Attributes:
        shared: (g, g).
        poses: (n, 6, 6) diagonal blocks of the target poses.
        corners: (c, 3, 3) diagonal blocks of the corners.
        shared_poses: (g, 6 n).
    """

    shared: FloatArray
    poses: FloatArray
    corners: FloatArray
    shared_poses: FloatArray


class Elimination:
    """A matrix with its larger family of blocks eliminated.

    Raises:
        numpy.linalg.LinAlgError: a block of the eliminated family is singular.
    """

    def __init__(self, matrix: BlockMatrix) -> None:
        self._shared_count = len(matrix.shared)
        self.eliminates_corners = matrix.corners.size > 0 and (
            3 * len(matrix.corners) >= 6 * len(matrix.poses)
        )
        if self.eliminates_corners:
            blocks, others, beside = matrix.corners, matrix.poses, matrix.shared_poses
            self._coupling = np.concatenate([matrix.shared_corners, matrix.poses_corners])
        else:
            blocks, others, beside = matrix.poses, matrix.corners, matrix.shared_corners
            self._coupling = np.concatenate([matrix.shared_poses, matrix.poses_corners.T])
        self._inverses = np.linalg.inv(blocks)
        self._gain = self._times_inverses(self._coupling)
        self._schur = np.block([[matrix.shared, beside], [beside.T, _diagonal(others)]])
        self._schur -= self._gain @ self._coupling.T
        self._others_shape = (len(others), others.shape[1])

    def step(self, right: Step, damping: float) -> Step:
        """Return the solution of ``matrix @ step = -right``.

        Args:
            right: gradient of half the cost.
            damping: factor of the diagonal of the Schur complement that is added to it.
        """
        kept, gone = self._parts(right)
        schur = self._schur + damping * np.diag(np.diag(self._schur))
        solved = np.linalg.solve(schur, kept.ravel() - self._gain @ gone.ravel())
        moved = np.asarray(-solved, dtype=np.float64)
        rest = (gone.ravel() + self._coupling.T @ moved).reshape(gone.shape)
        back = np.asarray(-np.einsum("nij,nj->ni", self._inverses, rest), dtype=np.float64)
        shared, others = moved[: self._shared_count], moved[self._shared_count :]
        others = others.reshape(self._others_shape)
        poses, corners = (others, back) if self.eliminates_corners else (back, others)
        return Step(shared, poses, corners)

    @cached_property
    def covariance(self) -> Covariance:
        """Blocks of the inverse.

        Raises:
            numpy.linalg.LinAlgError: the matrix is singular.
        """
        count, size = self._shared_count, self._others_shape[1]
        inverse = np.asarray(np.linalg.inv(self._schur), dtype=np.float64)
        cross = inverse @ self._gain
        blocks, width = len(self._inverses), self._inverses.shape[1]
        gain = self._gain.reshape(-1, blocks, width)
        added = np.einsum("rni,rnj->nij", gain, cross.reshape(-1, blocks, width))
        eliminated = self._inverses + added
        places = count + np.arange(self._others_shape[0] * size).reshape(-1, size)
        others = inverse[places[:, :, None], places[:, None, :]]
        if self.eliminates_corners:
            return Covariance(inverse[:count, :count], others, eliminated, inverse[:count, count:])
        return Covariance(inverse[:count, :count], eliminated, others, -cross[:count])

    def _times_inverses(self, rows: FloatArray) -> FloatArray:
        blocks, width = len(self._inverses), self._inverses.shape[1]
        block_rows = rows.reshape(len(rows), blocks, width).transpose(1, 0, 2)
        return (block_rows @ self._inverses).transpose(1, 0, 2).reshape(len(rows), -1)

    def _parts(self, right: Step) -> tuple[FloatArray, FloatArray]:
        """Return the vector of what is kept, and that of what is eliminated."""
        if self.eliminates_corners:
            return np.concatenate([right.shared, right.poses.ravel()]), right.corners
        return np.concatenate([right.shared, right.corners.ravel()]), right.poses


def _diagonal(blocks: FloatArray) -> FloatArray:
    """(n k, n k) matrix with the (n, k, k) blocks on its diagonal."""
    count, size = blocks.shape[:2]
    matrix = np.zeros((count, size, count, size))
    at = np.arange(count)
    matrix[at, :, at, :] = blocks
    return matrix.reshape(count * size, count * size)
