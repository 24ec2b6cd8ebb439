"""Base parameters: the combinations of parameters that motion and effort can determine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.identification.regressor.columns import Column
from pytest_twin.identification.regressor.regressor import Regressor

RANK_TOLERANCE = 1e-4
"""Relative size of a column's component orthogonal to the other columns below which it is zero.
Dependent columns have 1e-13, or up to 1e-5 where an exporter rounded a right angle (1.5708);
columns that the motion excites have more than 1e-3."""
_STILL = 1e-7
"""Relative size of a column below which the motion does not move its parameter."""
_RELEVANT_SHARE = 1e-3
"""Smallest coefficient, for columns of unit length, with which a motion regroups parameters."""
_SAMPLES_PER_COLUMN = 4
"""Number of random samples for each column per joint: more equations than parameters."""
COEFFICIENT_TOLERANCE = 1e-5
"""Smallest coefficient of an expression, for columns of unit length. Smaller ones are rounding: a
right angle of an exporter is off by up to 1e-5 rad. With them friction would have no name of its
own."""
_DIGITS = 6
"""Number of significant digits of a coefficient in an expression."""


@dataclass(frozen=True)
class BaseParameters:
    """A minimal set of parameters, as linear combinations of all parameters.

    Attributes:
        columns: (p,) all parameters.
        independent: (b,) indices of the independent columns of the regressor.
        combination: (b, p) ``base = combination @ parameters``.
    """

    columns: tuple[Column, ...]
    independent: NDArray[np.intp]
    combination: FloatArray

    def __len__(self) -> int:
        return len(self.independent)

    @property
    def names(self) -> tuple[str, ...]:
        """(b,) name of the leading parameter of each combination, ``JOINT.KIND``."""
        return tuple(self.columns[i].name for i in self.independent)

    @property
    def expressions(self) -> tuple[str, ...]:
        """(b,) sums in the symbols of the literature: ``Izz1 + Ia1 + Iyy2``."""
        return tuple(
            " ".join(self._terms(row, lambda column: column.symbol))
            for row in range(len(self.independent))
        )

    @property
    def words(self) -> tuple[str, ...]:
        """(b,) the same sums with the joints' names."""
        return tuple(
            " ".join(self._terms(row, lambda column: column.words))
            for row in range(len(self.independent))
        )

    @property
    def units(self) -> tuple[str, ...]:
        """(b,) unit of each base parameter."""
        return tuple(self.columns[i].unit for i in self.independent)

    def matrix(self, regressor: FloatArray) -> FloatArray:
        """(n, joints, b) the base columns of a regressor (n, joints, p)."""
        return np.asarray(regressor[..., self.independent])

    def values(self, parameters: FloatArray) -> FloatArray:
        """(b,) base parameters of (p,) parameters."""
        return np.asarray(self.combination @ parameters)

    def regrouped(self, rows: FloatArray) -> tuple[BaseParameters, NDArray[np.bool_]]:
        """Return the parameters that a motion distinguishes.

        A parameter whose column depends on those before it is added to these: the motion determines
        their sum. Drives come first: a weight that a motion does not vary is a constant effort.
        Parameters that it does not move stay.

        Args:
            rows: (n, b) weighted base columns along the motion.

        Returns:
            k base parameters; (k,) True for those that the motion does not move.
        """
        sizes = np.linalg.norm(rows, axis=0)
        moved = sizes > _STILL * sizes.max(initial=0.0)
        unit = rows / np.where(moved, sizes, np.inf)
        triangle = np.asarray(scipy.linalg.qr(unit, mode="r")[0], dtype=np.float64)
        triangle = triangle[: rows.shape[1]]
        of_links = [self.columns[i].is_inertial for i in self.independent]
        order = np.argsort(of_links, kind="stable")
        kept = np.sort(order[_independent(triangle[:, order])])
        lost = np.flatnonzero(moved & ~np.isin(np.arange(len(self)), kept))
        solved = np.linalg.lstsq(triangle[:, kept], triangle[:, lost], rcond=None)[0]
        share = np.where(np.abs(solved) < _RELEVANT_SHARE, 0.0, solved)
        combination = self.combination.copy()
        combination[kept] += (share * sizes[lost] / sizes[kept][:, None]) @ self.combination[lost]
        rest = np.setdiff1d(np.arange(len(self)), lost)
        regrouped = BaseParameters(self.columns, self.independent[rest], combination[rest])
        return regrouped, ~moved[rest]

    def _terms(self, row: int, said: Callable[[Column], str]) -> list[str]:
        kept = self.independent[row]
        others = [i for i in np.flatnonzero(self.combination[row]) if i != kept]
        found = [said(self.columns[kept])]
        for i in others:
            factor = self.combination[row, i]
            size = float(f"{abs(factor):.{_DIGITS}g}")
            times = "" if size == 1.0 else f"{size:g}*"
            found += ["-" if factor < 0 else "+", f"{times}{said(self.columns[i])}"]
        return found


def structural_base(regressor: Regressor) -> BaseParameters:
    """Return the base parameters of a robot that some motion can determine.

    The regressor is evaluated at random positions, velocities and accelerations, so the rank
    depends on the robot only and not on a trajectory.
    """
    count = len(regressor.joints)
    samples = _SAMPLES_PER_COLUMN * max(1, len(regressor.columns) // count)
    return base_of(regressor.random_matrix(samples, 0), regressor.columns)


def base_of(matrix: FloatArray, columns: Sequence[Column]) -> BaseParameters:
    """Return the base parameters of a regressor, by rank-revealing QR (Gautier, ICRA 1991).

    Columns are kept from left to right: a parameter is regrouped into those before it.

    Args:
        matrix: (n, joints, p) regressor at the instants of a motion.
        columns: (p,) description of each column.
    """
    stacked = np.asarray(matrix).reshape(-1, len(columns))
    sizes = np.linalg.norm(stacked, axis=0)
    scale = np.where(sizes > RANK_TOLERANCE * sizes.max(initial=0.0), sizes, np.inf)
    # The triangle has the same column dependencies and at most p rows.
    whole = np.asarray(scipy.linalg.qr(stacked / scale, mode="r")[0], dtype=np.float64)
    triangle = whole[: len(columns)]
    independent = np.array(_independent(triangle), dtype=np.intp)
    solved = np.linalg.lstsq(triangle[:, independent], triangle, rcond=None)[0]
    own = np.where(np.isfinite(scale), scale, 0.0)
    combination = solved * own / scale[independent][:, None]
    combination[np.abs(solved) < COEFFICIENT_TOLERANCE] = 0.0
    combination[:, independent] = np.eye(len(independent))
    return BaseParameters(tuple(columns), independent, combination)


def _independent(unit: FloatArray) -> list[int]:
    """Return the columns, from left to right, that do not depend on those before them.

    Args:
        unit: (n, p) columns of unit length or zero.
    """
    kept: list[int] = []
    basis = np.zeros((len(unit), 0))
    for at, column in enumerate(unit.T):
        rest = column - basis @ (basis.T @ column)
        rest -= basis @ (basis.T @ rest)
        size = float(np.linalg.norm(rest))
        if size > RANK_TOLERANCE:
            kept.append(at)
            basis = np.column_stack([basis, rest / size])
    return kept
