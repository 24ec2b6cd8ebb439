"""Test whether the arm bends under gravity, and widen the intervals by what that would change.

A joint that gives turns by its compliance times the torque of gravity, which follows from the
configuration. Poses of a calibration have this error in common, so that camera and base take up a
part of it, and the residuals show only the rest. Nothing else would widen the intervals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.further_columns import free_columns, widened
from pytest_twin.calibration.problem import CalibrationProblem, arms
from pytest_twin.calibration.records import CalibrationEstimate
from pytest_twin.calibration.solve import Fit, prior_rows, prior_values
from pytest_twin.realization.serial_chain import SerialChain

_CHANCE = 1e-3
"""Significance level of the compliance."""
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
    return replace(found, covariance=widened(found.covariance, wider)), bent


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
    tested = free_columns(fit, fit.jacobian, bent, residuals_of_fit)
    count = fit.jacobian.shape[1]
    bending = np.einsum("nc,c,ncx->nx", torques, tested.step[count:], displaced)
    more = len(wide) - len(residuals)
    beyond = free_columns(
        fit, wide, np.vstack([slopes, np.zeros((more, slopes.shape[1]))]),
        np.concatenate([residuals, np.zeros(more)]),
    )  # fmt: skip
    return Compliance(
        tested.probability,
        tested.removes,
        tested.shift,
        tested.covariance,
        np.linalg.norm(bending, axis=1),
        beyond.probability < _CHANCE,
    )


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
