"""Test whether the arm bends under gravity, and widen the intervals by what that would change.

A joint that gives turns by its compliance times the torque of gravity, which follows from the
configuration. Poses of a calibration have this error in common, so that camera and base take up a
part of it, and the residuals show only the rest. Nothing else would widen the intervals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import stats

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.problem import CalibrationProblem, arms
from pytest_twin.calibration.records import CalibrationEstimate
from pytest_twin.calibration.solve import Fit, prior_rows, prior_values
from pytest_twin.realization.serial_chain import SerialChain

_CHANCE = 1e-3
"""Significance level of the compliance."""
_FEWEST_DEGREES = 20
"""Residuals beyond the unknowns, with the compliances, from which these are tested."""
_NEGLIGIBLE = 1e-9
"""Singular values, relative to the largest, of directions that the residuals do not show."""

_GRAVITY = 9.81
"""m/s^2."""


@dataclass(frozen=True)
class Compliance:
    """Result of freeing the compliance of each joint, to first order.

    Attributes:
        probability: that an arm that does not bend shows as much (F test).
        removes: share of the squared residuals that bending explains.
        shift: (count,) change of the unknowns, m and rad.
        covariance: (count, count) covariance of the unknowns with free compliances.
        bending: (rows,) displacement of the flange by the fitted compliances, m.
        is_clear: whether free joint zeros and link geometry leave the compliance as significant.
    """

    probability: float
    removes: float
    shift: FloatArray
    covariance: FloatArray
    bending: FloatArray
    is_clear: bool

    @property
    def words(self) -> str:
        """What the residuals show, what was done, and what to measure next."""
        size = 1e3 * float(self.bending.max())
        cause = (
            f"the arm bends, by about {size:.2g} mm at most"
            if self.is_clear
            else f"the arm bends, by {size:.2g} mm at most, or joint zeros or geometry are wrong"
        )
        return (
            f"the residuals follow the torque of gravity at the joints: {cause} "
            f"({100 * self.removes:.0f} % of the squared residuals; by chance "
            f"{self.probability:.1g}). Compliance is no part of this calibration, so the intervals "
            "are widened by what it would change. Next: repeat poses with another payload (column "
            "payload), or calibrate at the poses of the task"
        )

    def to_json(self) -> dict[str, Any]:
        """JSON-compatible result."""
        return {
            "probability": self.probability,
            "removes": self.removes,
            "largest_bending": {"value": float(self.bending.max()), "unit": "m"},
        }


def with_compliance(
    found: CalibrationEstimate,
) -> tuple[CalibrationEstimate, Compliance | None]:
    """Return the estimate with wider intervals if the arm bends under gravity, and the test.

    The arm stands upright: gravity acts along -z of the base. Without joint readings of a robot,
    or with too few residuals, nothing is tested.
    """
    bent = _compliance(found.fit)
    if bent is None or bent.probability > _CHANCE:
        return found, None
    wider = np.outer(bent.shift, bent.shift) + bent.covariance
    # Both matrices are covariances, so the larger variance of each unknown is kept.
    larger = np.sqrt(np.maximum(np.diag(wider), np.diag(found.covariance)) / np.diag(wider))
    return replace(found, covariance=wider * np.outer(larger, larger)), bent


def _compliance(fit: Fit) -> Compliance | None:
    problem, chain = fit.problem, fit.problem.chain
    if chain is None or not fit.jacobian.shape[1]:
        return None
    readings = np.stack([problem.observations.joints[name] for name in chain.joints], axis=1)
    values = chain.signs * readings + chain.offsets + fit.state.zeros
    joints, torques, displaced = _gravity(chain, values)
    residuals, wide, slopes = _by_compliance(fit, arms(problem)[-1], joints, torques)
    residuals_of_fit = np.concatenate([residuals, prior_values(problem, fit.state)])
    priors = len(fit.jacobian) - len(residuals)
    bent = np.vstack([slopes, np.zeros((priors, slopes.shape[1]))])
    probability, removes, step, rigid_step = _test(fit, fit.jacobian, bent, residuals_of_fit)
    count = fit.jacobian.shape[1]
    free = np.hstack([fit.jacobian, bent])
    left = np.sum((residuals_of_fit + free @ step) ** 2) / _degrees(fit, free)
    bending = np.einsum("nc,c,ncx->nx", torques, step[count:], displaced)
    more = len(wide) - len(residuals)
    beyond = _test(
        fit, wide, np.vstack([slopes, np.zeros((more, slopes.shape[1]))]),
        np.concatenate([residuals, np.zeros(more)]),
    )  # fmt: skip
    return Compliance(
        probability,
        removes,
        step[:count] - rigid_step,
        left * np.linalg.pinv(free.T @ free, rcond=_NEGLIGIBLE)[:count, :count],
        np.linalg.norm(bending, axis=1),
        beyond[0] < _CHANCE,
    )


def _degrees(fit: Fit, slopes: FloatArray) -> int:
    """Number of inlier residuals and priors beyond the rank of the derivatives."""
    terms = zip(fit.problem.terms, fit.kept, strict=True)
    outliers = sum(int((~kept).sum()) * len(term.noise) for term, kept in terms)
    return len(slopes) - outliers - int(np.linalg.matrix_rank(slopes / _sizes(slopes)))


def _test(
    fit: Fit, slopes: FloatArray, more: FloatArray, residuals: FloatArray
) -> tuple[float, float, FloatArray, FloatArray]:
    """Probability that further columns explain as much by chance (F test), their share of the
    squared residuals, and the steps with and without them."""
    free = np.hstack([slopes, more])
    step, rest_step = (_step(table, residuals) for table in (free, slopes))
    left, rest = (
        float(np.sum((residuals + table @ moved) ** 2))
        for table, moved in ((free, step), (slopes, rest_step))
    )
    degrees, before = _degrees(fit, free), _degrees(fit, slopes)
    probability = 1.0
    if degrees >= _FEWEST_DEGREES and before > degrees and left > 0.0:
        ratio = (rest - left) / (before - degrees) / (left / degrees)
        probability = float(stats.f.sf(ratio, before - degrees, degrees))
    return probability, 1.0 - left / rest if rest else 0.0, step, rest_step


def _sizes(slopes: FloatArray) -> FloatArray:
    sizes: FloatArray = np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
    return sizes


def _step(slopes: FloatArray, residuals: FloatArray) -> FloatArray:
    """Least-squares step of the unknowns."""
    size = _sizes(slopes)
    step: FloatArray = np.linalg.lstsq(slopes / size, -residuals, rcond=_NEGLIGIBLE)[0] / size
    return step


def _gravity(chain: SerialChain, values: FloatArray) -> tuple[list[int], FloatArray, FloatArray]:
    """Torques of gravity at the revolute joints, for two distributions of one kilogram.

    The masses of links are rarely known, so both a mass at the flange and a mass spread over the
    frames behind the joint are tried.

    Args:
        values: (rows, n) joint values, rad or m.

    Returns:
        For each column its joint, (rows, columns) torques, N*m, and (rows, columns, 3)
        displacements of the flange for one radian.
    """
    places, axes = chain.frames(values)
    joints, torques, displaced = [], [], []
    for joint in np.flatnonzero(chain.revolute).tolist():
        behind = places[:, joint + 1 :] - places[:, joint, None]
        turn = np.cross(axes[:, joint], behind[:, -1])
        for lever in (behind[:, -1], behind.mean(axis=1)):
            torque = -_GRAVITY * np.cross(axes[:, joint], lever)[:, 2]
            joints.append(joint)
            torques.append(torque)
            displaced.append(turn)
    return joints, np.stack(torques, axis=1), np.stack(displaced, axis=1)


def _by_compliance(
    fit: Fit, wider: CalibrationProblem, joints: list[int], torques: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals and derivatives, divided by their noise; those of outliers are 0.

    Args:
        wider: the problem with free joint zeros and link geometry. A bent joint is one whose zero
            has moved.

    Returns:
        (m,) residuals, (m + priors, unknowns) derivatives of the wider problem, and (m, columns) by
        compliances.
    """
    links = fit.state.links
    if len(links) != len(wider.layout.links):
        links = np.zeros(len(wider.layout.links))
    zeros = wider.layout.blocks["joint_zeros"]
    columns = [
        (zeros.start + wider.layout.zeros.index(joint), at)
        for at, joint in enumerate(joints)
        if joint in wider.layout.zeros
    ]
    residuals, wide, slopes = [], [], []
    of_terms = wider.residuals(replace(fit.state, links=links), np.zeros(wider.layout.count))
    for term, (residual, slope), kept in zip(wider.terms, of_terms, fit.kept, strict=True):
        weight = kept[:, None] / np.array([fit.noise[name] for name in term.noise])
        slope = slope * weight[:, :, None]
        residuals.append((residual * weight).reshape(-1))
        wide.append(slope.reshape(-1, slope.shape[2]))
        bent = [slope[:, :, column] * torques[term.rows, at, None] for column, at in columns]
        slopes.append(np.stack(bent, axis=2).reshape(-1, len(columns)))
    return (
        np.concatenate(residuals),
        np.concatenate([*wide, prior_rows(wider)]),
        np.concatenate(slopes),
    )
