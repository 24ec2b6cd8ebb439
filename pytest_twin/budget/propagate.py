"""Propagate covariances through the forward kinematics, to first order and by random draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ndtri
from scipy.stats import qmc

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.transform_derivatives import TransformWithJacobian
from pytest_twin.errors import FormatError

DRAWS = 256
"""Number of draws, a power of two as Sobol's sequence requires. The RMS of a linear output is then
accurate to 1 %; 64 draws gave 3 %."""
LARGEST_DIFFERENCE = 0.2
"""Relative difference between both methods above which the linearization is not valid."""
_NEGATIVE = -1e-6
"""Smallest eigenvalue of a correlation matrix. Rounding errors are about 1e-12."""
_SEED = 57
"""Seed of the random draws, so that a budget can be repeated."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Displacement of a pose by one standard deviation of its causes.

    Attributes:
        position: root mean square of the displacement over all poses, m.
        rotation: root mean square of the rotation angle, rad.
        worst_position, worst_rotation: values at the pose with the largest one, m and rad.
    """

    position: float
    rotation: float
    worst_position: float
    worst_rotation: float

    def to_json(self) -> dict[str, float]:
        """Return fields for JSON, in m and rad."""
        return {
            "position": self.position,
            "rotation": self.rotation,
            "worst_position": self.worst_position,
            "worst_rotation": self.worst_rotation,
        }


def root_of(covariance: FloatArray, path: Path) -> FloatArray:
    """(p, p) root ``L`` with ``L L^T = covariance``, also of singular covariances.

    Args:
        covariance: (p, p) covariance.
        path: path of its record, for errors.

    Raises:
        FormatError: the matrix is not symmetric, or not positive semidefinite.
    """
    deviations = np.sqrt(np.diag(covariance).clip(0.0))
    scale = np.where(deviations > 0.0, deviations, 1.0)
    correlation = covariance / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(0.5 * (correlation + correlation.T))
    skewed = float(np.abs(correlation - correlation.T).max(initial=0.0))
    least = float(values.min(initial=0.0))
    if skewed > -_NEGATIVE or least < _NEGATIVE or np.diag(covariance).min(initial=0.0) < 0.0:
        what = "is not symmetric" if skewed > -_NEGATIVE else "has a negative eigenvalue"
        raise FormatError(
            f"its covariance {what}",
            path=path,
            where="covariance",
            value=skewed if skewed > -_NEGATIVE else least,
            expected="a symmetric, positive semidefinite matrix; make the record again",
        )
    root: FloatArray = scale[:, None] * vectors * np.sqrt(values.clip(0.0))
    return root


def normal_draws(root: FloatArray, count: int = DRAWS) -> FloatArray:
    """(count, p) draws from the normal distribution of a covariance's root.

    Scrambled Sobol points are mapped by the inverse normal distribution function. Their moments
    converge faster than those of independent draws (Owen, 1998).
    """
    points = qmc.Sobol(root.shape[1], scramble=True, seed=_SEED).random(count)
    drawn: FloatArray = ndtri(points.clip(1e-12, 1.0 - 1e-12)) @ root.T
    return drawn


def first_order(moving: TransformWithJacobian, root: FloatArray) -> Spread:
    """Return the first-order displacement of poses, from ``J C J^T``.

    Args:
        moving: n poses with (n, 3, p) derivatives.
        root: (p, k) root of the covariance.
    """
    shift = np.sum((moving.shift @ root) ** 2, axis=(1, 2))
    turn = np.sum((moving.turn @ root) ** 2, axis=(1, 2))
    return spread_of(shift, turn)


def sample_displacement(
    at: Callable[[FloatArray], TransformWithJacobian], draws: FloatArray
) -> Spread:
    """Return the displacement of poses over random draws of the unknowns.

    Args:
        at: function from a step of the unknowns (p,) to n poses.
        draws: (m, p) steps of the unknowns.
    """
    nominal = at(np.zeros(draws.shape[1]))
    shift, turn = np.zeros((2, len(nominal.position)))
    for draw in draws:
        moved = at(draw)
        shift += np.sum((moved.position - nominal.position) ** 2, axis=1)
        turn += angles(moved.rotation, nominal.rotation) ** 2
    return spread_of(shift / len(draws), turn / len(draws))


def angles(rotation: FloatArray, other: FloatArray) -> FloatArray:
    """(n,) angles between (n, 3, 3) orientations, rad."""
    between = Rotation.from_matrix(np.swapaxes(other, 1, 2) @ rotation)
    return np.asarray(between.magnitude(), dtype=np.float64)


def linearization_warnings(linear: Spread, drawn: Spread) -> list[str]:
    """Return warnings if both methods differ by more than ``LARGEST_DIFFERENCE``."""
    found = []
    for name, unit in (("position", "mm"), ("rotation", "mrad")):
        one, other = getattr(linear, name), getattr(drawn, name)
        larger = max(one, other)
        if larger > 0.0 and abs(one - other) > LARGEST_DIFFERENCE * larger:
            found.append(
                f"the {name} is {1e3 * one:.3g} {unit} to first order and {1e3 * other:.3g} {unit} "
                "by draws: over this covariance the linear rule does not hold; take the draws"
            )
    return found


def spread_of(shift: FloatArray, turn: FloatArray) -> Spread:
    """Build a spread from (n,) mean squares of displacement (m^2) and angle (rad^2)."""
    return Spread(
        float(np.sqrt(shift.mean())),
        float(np.sqrt(turn.mean())),
        float(np.sqrt(shift.max())),
        float(np.sqrt(turn.max())),
    )
