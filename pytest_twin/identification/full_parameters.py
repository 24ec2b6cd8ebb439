"""Physically consistent full parameters, from base parameters and the nominal model.

The data determine the base parameters; the nominal model determines how they are distributed among
the links. A link is parametrized by the log-Cholesky coordinates of its pseudo-inertia relative to
the nominal one (Rucker, Wensing, IEEE RA-L 7, 2022). Every value of the coordinates is a physical
body, and the same relative deviation costs the same for every link. This prior is invariant under
changes of frame and unit (Lee, Wensing, Park, IEEE T-RO 36, 2020).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue
from pytest_twin.effects.sensing import EffortScale
from pytest_twin.identification.regressor import Column
from pytest_twin.realization.inverse_dynamics import INERTIAL, pseudo_inertia

_PRIOR_STD = 0.3
"""Standard deviation of the log-Cholesky coordinates about the nominal model: 30 % of a link's mass
or radius of gyration. CAD models lack about this much in cables, motors and covers."""
_LIGHTEST = 1e-6
"""Smallest mass of a body, kg. Lighter bodies of a model are frames only."""
_SETTLED = 1e-6
"""Relative change of cost and parameters at which the fit ends."""
_OFF_BOUND = 1e-4
"""Distance of initial values from their bounds, SI units, so that the solver can move them."""
_PINOCCHIO = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
_ROWS = np.array([0, 1, 2, 3, 1, 2, 2, 3, 3, 3])
_COLUMNS = np.array([0, 1, 2, 3, 0, 0, 1, 0, 1, 2])
"""Entries of a triangular (4, 4) matrix: first the diagonal, then the rows below it."""
_TO_PINOCCHIO = [INERTIAL.index(name) for name in _PINOCCHIO]


def is_positive(kind: str) -> bool:
    """Whether no joint has a negative value of a parameter: armature, friction, a scale.

    Args:
        kind: kind of a column of a regressor.
    """
    effect = catalogue().get(kind)
    if effect is None or not effect.regressor_symbol:
        return kind == EffortScale.id
    return bool(effect.mjcf_field) or effect.parameters[0].lower >= 0.0


@dataclass(frozen=True)
class FullParameters:
    """Full parameters of links and drives.

    Attributes:
        parameters: (p,) parameters of all columns.
        is_consistent: whether every inertia is physical and no friction or armature is negative.
        cost: increase of the weighted sum of squares against the unconstrained estimate, per base
            parameter.
    """

    parameters: FloatArray
    is_consistent: bool
    cost: float


def fit_full_parameters(
    columns: Sequence[Column],
    prior: FloatArray,
    combination: FloatArray,
    base: FloatArray,
    information: FloatArray,
    fixed: NDArray[np.bool_],
) -> FullParameters:
    """Return the full parameters nearest to the nominal ones that agree with the data.

    Args:
        columns: (p,) description of the parameters.
        prior: (p,) nominal parameters.
        combination: (b, p) matrix from full to base parameters.
        base: (b,) estimated base parameters.
        information: (b, b) inverse covariance of the base parameters.
        fixed: (p,) True for parameters that keep the values of ``prior``. A link is fixed as a
            whole.
    """
    links = [link for link in _links(columns, prior) if not fixed[link.at]]
    others = np.array(
        [i for i, c in enumerate(columns) if not c.is_inertial and not fixed[i]], dtype=np.intp
    )
    root = _root(information)
    size = 10 * len(links)
    lower = np.concatenate([
        np.full(size, -np.inf),
        [0.0 if is_positive(columns[i].kind) else -np.inf for i in others],
    ])  # fmt: skip
    of_full = root @ combination
    measured = root @ base

    def whole(x: FloatArray) -> FloatArray:
        out = prior.copy()
        for k, link in enumerate(links):
            out[link.at : link.at + 10] = link.parameters(x[10 * k : 10 * k + 10])
        out[others] = x[size:]
        return out

    def residual(x: FloatArray) -> FloatArray:
        return np.concatenate([of_full @ whole(x) - measured, x[:size] / _PRIOR_STD])

    def slope(x: FloatArray) -> FloatArray:
        top = np.empty((len(root), len(x)))
        for k, link in enumerate(links):
            at = slice(10 * k, 10 * k + 10)
            top[:, at] = of_full[:, link.at : link.at + 10] @ link.slope(x[at])
        top[:, size:] = of_full[:, others]
        bottom = np.zeros((size, len(x)))
        bottom[:, :size] = np.eye(size) / _PRIOR_STD
        return np.concatenate([top, bottom])

    if not len(lower):
        values = prior.copy()
    else:
        # The drive parameters are linear. Their solution, moved off the bounds, is the start.
        bodies = prior.copy()
        bodies[others] = 0.0
        drives = lower[size:]
        if len(others):
            drives = optimize.lsq_linear(
                of_full[:, others], measured - of_full @ bodies, (lower[size:], np.inf)
            ).x
        start = np.concatenate([np.zeros(size), np.maximum(drives, lower[size:] + _OFF_BOUND)])
        found = optimize.least_squares(
            residual, start, slope, bounds=(lower, np.inf), x_scale="jac",
            ftol=_SETTLED, xtol=_SETTLED, max_nfev=200,
        )  # fmt: skip
        values = whole(found.x)
    off = of_full @ values - measured
    return FullParameters(
        parameters=values,
        is_consistent=_is_consistent(columns, values),
        cost=float(off @ off) / max(len(base), 1),
    )


class LinkInertia:
    """A link's pseudo-inertia relative to the nominal one: J = L_0 U U^T L_0^T, U triangular."""

    def __init__(self, at: int, stated: FloatArray) -> None:
        self.at = at
        matrix = pseudo_inertia(stated[_TO_PINOCCHIO])
        values, vectors = np.linalg.eigh(matrix)
        # A nominal link may be flat or unphysical. It is replaced by the nearest body with some
        # thickness.
        values = np.maximum(values, 1e-6 * values.max())
        self.root = np.linalg.cholesky(vectors @ np.diag(values) @ vectors.T)

    def parameters(self, x: FloatArray) -> FloatArray:
        """(10,) inertial parameters in the order of ``INERTIAL``."""
        triangle = self.root @ _triangle(x)
        return _of_pseudo(triangle @ triangle.T)

    def slope(self, x: FloatArray) -> FloatArray:
        """(10, 10) derivative of the parameters by the coordinates."""
        triangle = self.root @ _triangle(x)
        size = np.concatenate([np.exp(x[:4]), np.ones(6)])
        # The derivative of J by one entry of U has rank two.
        half = size[:, None, None] * (
            self.root[:, _ROWS].T[:, :, None] * triangle[:, _COLUMNS].T[:, None, :]
        )
        return _of_pseudo(half + half.swapaxes(1, 2)).T


def _triangle(x: FloatArray) -> FloatArray:
    """(4, 4) U from log-Cholesky coordinates: logarithms of the diagonal, then entries below it."""
    found = np.zeros((4, 4))
    found[_ROWS, _COLUMNS] = x
    found[_ROWS[:4], _COLUMNS[:4]] = np.exp(x[:4])
    return found


def _of_pseudo(matrix: FloatArray) -> FloatArray:
    """(..., 10) parameters in the order of ``INERTIAL``; inverse of :func:`pseudo_inertia`."""
    sigma = matrix[..., :3, :3]
    tensor = np.trace(sigma, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - sigma
    named = {
        **{f"I{'xyz'[i]}{'xyz'[k]}": tensor[..., i, k] for i in range(3) for k in range(i, 3)},
        **{f"m{'xyz'[i]}": matrix[..., i, 3] for i in range(3)},
        "m": matrix[..., 3, 3],
    }
    return np.stack([named[name] for name in INERTIAL], axis=-1)


def _links(columns: Sequence[Column], prior: FloatArray) -> list[LinkInertia]:
    starts = [i for i, c in enumerate(columns) if c.kind == INERTIAL[0]]
    mass = INERTIAL.index("m")
    return [LinkInertia(i, prior[i : i + 10]) for i in starts if prior[i + mass] > _LIGHTEST]


def _root(information: FloatArray) -> FloatArray:
    """(b, b) R with R^T R = information, whose entries may differ in unit and size."""
    sizes = np.sqrt(np.diag(information).clip(1e-300))
    values, vectors = np.linalg.eigh(information / np.outer(sizes, sizes))
    return np.asarray(np.sqrt(values.clip(0.0))[:, None] * vectors.T * sizes)


def _is_consistent(columns: Sequence[Column], values: FloatArray) -> bool:
    starts = [i for i, c in enumerate(columns) if c.kind == INERTIAL[0]]
    mass = INERTIAL.index("m")
    for i in starts:
        own = values[i : i + 10]
        if own[mass] <= _LIGHTEST:
            continue
        matrix = pseudo_inertia(own[_TO_PINOCCHIO])
        if np.linalg.eigvalsh(matrix).min() < -1e-9 * np.trace(matrix):
            return False
    drives = [i for i, c in enumerate(columns) if is_positive(c.kind)]
    return bool((values[drives] >= 0.0).all())
