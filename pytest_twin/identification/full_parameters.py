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
from scipy import optimize

from pytest_twin.arrays import FloatArray
from pytest_twin.identification.regressor import Column
from pytest_twin.realization.inverse_dynamics import INERTIAL, pseudo_inertia

_PRIOR_STD = 0.3
"""Standard deviation of the log-Cholesky coordinates about the nominal model: 30 % of a link's mass
or radius of gyration. CAD models lack about this much in cables, motors and covers."""
_LIGHTEST = 1e-6
"""Smallest mass of a body, kg. Lighter bodies of a model are frames only."""
_OFF_BOUND = 1e-4
"""Distance of initial values from their bounds, SI units, so that the solver can move them."""
_NOT_NEGATIVE = frozenset({"armature", "viscous_friction", "coulomb_friction", "effort_scale"})
_PINOCCHIO = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
_ROWS = np.array([0, 1, 2, 3, 1, 2, 2, 3, 3, 3])
_COLUMNS = np.array([0, 1, 2, 3, 0, 0, 1, 0, 1, 2])
"""Entries of a triangular (4, 4) matrix: first the diagonal, then the rows below it."""
_TO_PINOCCHIO = [INERTIAL.index(name) for name in _PINOCCHIO]


@dataclass(frozen=True)
class FullParameters:
    """Full parameters of links and drives.

    Attributes:
        parameters: (p,) parameters of all columns.
        is_consistent: whether every inertia is physical and no friction or armature is negative.
        violations: one line for each unphysical value of the unconstrained estimate.
        cost: increase of the weighted sum of squares against the unconstrained estimate, per base
            parameter.
    """

    parameters: FloatArray
    is_consistent: bool
    violations: tuple[str, ...]
    cost: float


def fit_full_parameters(
    columns: Sequence[Column],
    prior: FloatArray,
    combination: FloatArray,
    base: FloatArray,
    information: FloatArray,
) -> FullParameters:
    """Return the full parameters nearest to the nominal ones that agree with the data.

    Args:
        columns: (p,) description of the parameters.
        prior: (p,) nominal parameters.
        combination: (b, p) matrix from full to base parameters.
        base: (b,) estimated base parameters.
        information: (b, b) inverse covariance of the base parameters.
    """
    links = _links(columns, prior)
    others = np.array([i for i, c in enumerate(columns) if not c.is_inertial], dtype=np.intp)
    root = _root(information)
    size = 10 * len(links)
    lower = np.concatenate([
        np.full(size, -np.inf),
        [0.0 if columns[i].kind in _NOT_NEGATIVE else -np.inf for i in others],
    ])  # fmt: skip

    def whole(x: FloatArray) -> FloatArray:
        out = prior.copy()
        for k, link in enumerate(links):
            out[link.at : link.at + 10] = link.parameters(x[10 * k : 10 * k + 10])
        out[others] = x[size:]
        return out

    def residual(x: FloatArray) -> FloatArray:
        off = root @ (combination @ whole(x) - base)
        return np.concatenate([off, x[:size] / _PRIOR_STD])

    def slope(x: FloatArray) -> FloatArray:
        change = np.zeros((len(columns), len(x)))
        for k, link in enumerate(links):
            at = slice(10 * k, 10 * k + 10)
            change[link.at : link.at + 10, at] = link.slope(x[at])
        change[others, size + np.arange(len(others))] = 1.0
        top = root @ combination @ change
        bottom = np.zeros((size, len(x)))
        bottom[:, :size] = np.eye(size) / _PRIOR_STD
        return np.concatenate([top, bottom])

    # The drive parameters are linear. Their solution, moved off the bounds, is the initial value.
    bodies = prior.copy()
    bodies[others] = 0.0
    drives = optimize.lsq_linear(
        root @ combination[:, others],
        root @ (base - combination @ bodies),
        (lower[size:], np.inf),
    ).x
    start = np.concatenate([np.zeros(size), np.maximum(drives, lower[size:] + _OFF_BOUND)])
    found = optimize.least_squares(
        residual, start, slope, bounds=(lower, np.inf), x_scale="jac", max_nfev=200
    )
    values = whole(found.x)
    off = root @ (combination @ values - base)
    return FullParameters(
        parameters=values,
        is_consistent=_is_consistent(columns, values),
        violations=tuple(_violations(columns, combination, base)),
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
        columns = []
        for k in range(10):
            row, column = _ROWS[k], _COLUMNS[k]
            size = np.exp(x[k]) if k < 4 else 1.0
            # The derivative of J by one entry of U has rank two.
            half = size * np.outer(self.root[:, row], triangle[:, column])
            columns.append(_of_pseudo(half + half.T))
        return np.array(columns).T


def _triangle(x: FloatArray) -> FloatArray:
    """(4, 4) U from log-Cholesky coordinates: logarithms of the diagonal, then entries below it."""
    found = np.zeros((4, 4))
    found[_ROWS, _COLUMNS] = x
    found[_ROWS[:4], _COLUMNS[:4]] = np.exp(x[:4])
    return found


def _of_pseudo(matrix: FloatArray) -> FloatArray:
    """(10,) parameters in the order of ``INERTIAL``; the inverse of :func:`pseudo_inertia`."""
    sigma, moment, mass = matrix[:3, :3], matrix[:3, 3], matrix[3, 3]
    tensor = np.trace(sigma) * np.eye(3) - sigma
    named = {
        "Ixx": tensor[0, 0], "Ixy": tensor[0, 1], "Ixz": tensor[0, 2], "Iyy": tensor[1, 1],
        "Iyz": tensor[1, 2], "Izz": tensor[2, 2], "mx": moment[0], "my": moment[1],
        "mz": moment[2], "m": mass,
    }  # fmt: skip
    return np.array([named[name] for name in INERTIAL])


def _links(columns: Sequence[Column], prior: FloatArray) -> list[LinkInertia]:
    starts = [i for i, c in enumerate(columns) if c.kind == INERTIAL[0]]
    mass = INERTIAL.index("m")
    return [LinkInertia(i, prior[i : i + 10]) for i in starts if prior[i + mass] > _LIGHTEST]


def _root(information: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(information)
    return np.asarray(np.sqrt(values.clip(0.0))[:, None] * vectors.T)


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
    drives = [i for i, c in enumerate(columns) if c.kind in _NOT_NEGATIVE]
    return bool((values[drives] >= 0.0).all())


def _violations(columns: Sequence[Column], combination: FloatArray, base: FloatArray) -> list[str]:
    """Return unphysical unconstrained estimates of drive parameters that are base parameters."""
    found = []
    for row, value in zip(combination, base, strict=True):
        terms = np.flatnonzero(row)
        if len(terms) == 1 and columns[terms[0]].kind in _NOT_NEGATIVE and value < 0.0:
            column = columns[terms[0]]
            found.append(f"{column.words} is negative: {value:.4g} {column.unit}")
    return found
