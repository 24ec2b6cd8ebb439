"""Bodies in coordinates in which every value is a real body.

``J = L U U^T L^T`` with the pseudo-inertia ``L L^T`` of a known body and ``U`` lower triangular:
exponentials of the first four coordinates on its diagonal and the other six below it (Rucker,
Wensing, IEEE RA-L 7, 2022). All coordinates 0: the known body.
"""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray

AXES = ("d1", "d2", "d3", "d4", "l21", "l31", "l32", "l41", "l42", "l43")
"""Names of the coordinates: logarithms of the diagonal of ``U``, then what is below it."""
COUNT = len(AXES)
_THINNEST = 1e-6
"""Share of the largest eigenvalue of the pseudo-inertia: a flat body gets this thickness."""


def root_of_body(pseudo_inertia: FloatArray) -> FloatArray:
    """(4, 4) ``L`` of the nearest real body.

    A model's body may be flat, or impossible; the nearest one with some thickness stands in.

    Args:
        pseudo_inertia: (4, 4), as :func:`~.inverse_dynamics.pseudo_inertia` has it.
    """
    values, vectors = np.linalg.eigh(pseudo_inertia)
    values = np.maximum(values, _THINNEST * values.max())
    return np.asarray(np.linalg.cholesky(vectors @ np.diag(values) @ vectors.T))


def side_at(root: FloatArray, x: FloatArray) -> FloatArray:
    """(..., 4, 4) ``L U`` at coordinates (..., 10), a root of the pseudo-inertia."""
    upper = np.zeros((*x.shape[:-1], 4, 4))
    row, column = np.tril_indices(4, -1)
    diagonal = np.arange(4)
    upper[..., diagonal, diagonal] = np.exp(x[..., :4])
    upper[..., row, column] = x[..., 4:]
    return np.asarray(root @ upper)


def pseudo_inertia_at(root: FloatArray, x: FloatArray) -> FloatArray:
    """(..., 4, 4) pseudo-inertia at coordinates (..., 10)."""
    side = side_at(root, x)
    return np.asarray(side @ np.swapaxes(side, -1, -2))


def rigid_at(root: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(n,) mass [kg], (n, 3) centre of mass [m], (n, 3, 3) second moments about it [kg*m^2].

    The inertia about the centre is ``trace(S) 1 - S`` of these moments ``S``. They come from what
    of the first three rows of ``L U`` is orthogonal to the fourth: a difference of large moments
    would leave rounding, and may be no body's.

    Args:
        root: (4, 4).
        x: (n, 10).
    """
    side = side_at(root, x)
    last = side[:, 3]
    mass = np.einsum("ni,ni->n", last, last)
    com = np.einsum("nki,ni->nk", side[:, :3], last) / mass[:, None]
    rest = side[:, :3] - com[:, :, None] * last[:, None, :]
    return mass, com, rest @ np.swapaxes(rest, 1, 2)
