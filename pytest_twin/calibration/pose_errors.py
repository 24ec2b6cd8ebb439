"""Test whether errors follow the given poses, and widen the intervals by what that would change.

Flange poses come from a controller whose joint zeros and link lengths may be wrong, and poses of a
target from a focal length that may be wrong. Such errors repeat with the pose. Base and camera take
up a part of them, more observations do not average them, and the residuals show only the rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.further_columns import (
    FurtherColumns,
    free_columns,
    least_squares_step,
    widened,
)
from pytest_twin.calibration.parameters import Variables
from pytest_twin.calibration.problem import predicted_poses
from pytest_twin.calibration.records import CalibrationEstimate
from pytest_twin.calibration.solve import Fit, prior_values
from pytest_twin.calibration.terms import PointTerm, PoseTerm

_CHANCE = 0.01
"""Significance level of each kind of error. A false one widens the intervals."""
_PARTS = (slice(0, 3), slice(3, 6))
"""Position and orientation in the columns of a pose's error."""


@dataclass(frozen=True)
class PoseErrors:
    """An error that repeats with the pose.

    Attributes:
        kind: ``depth``, ``flange`` or ``scale``.
        probability: that independent errors show as much (F test).
        removes: share of the squared residuals that it explains.
        cause: the error with its size, as text; ``mend``: what to do.
    """

    kind: str
    probability: float
    removes: float
    cause: str
    mend: str

    @property
    def words(self) -> str:
        """What the residuals show, what was done, and what to do next."""
        return (
            f"{self._shown}, so the intervals are widened by what it would change. Next: "
            f"{self.mend}"
        )

    @property
    def found_words(self) -> str:
        """What the residuals show and what to do next, where no interval contains it."""
        return f"{self._shown}, and no interval contains it. Next: {self.mend}"

    @property
    def _shown(self) -> str:
        return (
            f"{self.cause} ({100 * self.removes:.0f} % of the squared residuals; by chance "
            f"{self.probability:.1g}). This is no part of this calibration"
        )

    def to_json(self) -> dict[str, Any]:
        """Return the test as JSON data."""
        return {"kind": self.kind, "probability": self.probability, "removes": self.removes}


def with_pose_errors(
    found: CalibrationEstimate,
) -> tuple[CalibrationEstimate, tuple[PoseErrors, ...]]:
    """Return the estimate with wider intervals if its errors follow the poses, and these errors.

    Nothing is tested without poses of a target, for images, whose intrinsics are estimated, and for
    odometry. Joint readings of a robot are tested for compliance instead of the flange's poses.
    """
    fit = found.fit
    terms = fit.problem.terms
    if found.lost.any() or not terms:
        return found, ()
    if all(isinstance(term, PointTerm) for term in terms):
        return _with_scale_of_points(found)
    if len(terms) != 1 or not isinstance(terms[0], PoseTerm):
        return found, ()
    if fit.problem.is_odometry or fit.problem.observations.images is not None:
        return found, ()
    errors: list[PoseErrors] = []
    depth = _depth(terms[0])
    found, deep = _with_columns(found, depth)
    if deep is not None:
        factor = 1.0 + float(deep.step[-1])
        errors.append(
            PoseErrors(
                "depth",
                deep.probability,
                deep.removes,
                f"depths of camera_from_target are {factor:.4f} times too small or too large: the "
                "focal length that measured them is probably wrong by this factor",
                "calibrate the camera's intrinsics, or give images",
            )
        )
    if fit.problem.chain is None:
        found, error = _with_flange_errors(found, terms[0], depth if deep is not None else None)
        errors += [] if error is None else [error]
    return found, tuple(errors)


def _with_scale_of_points(
    found: CalibrationEstimate,
) -> tuple[CalibrationEstimate, tuple[PoseErrors, ...]]:
    """Widen the intervals by a factor of all measured points, if the residuals show one."""
    terms = [term for term in found.fit.problem.terms if isinstance(term, PointTerm)]
    found, tested = _with_columns(found, *(-term.measured[:, :, None] for term in terms))
    if tested is None:
        return found, ()
    error = PoseErrors(
        "scale",
        tested.probability,
        tested.removes,
        f"positions of point.* fit the robot's motions {1.0 + float(tested.step[-1]):.4f} times as "
        "large: the tracker's scale or the robot's links are wrong by this factor",
        "measure a known length with the tracker, or give robot: and estimate geometry",
    )
    return found, (error,)


def _with_flange_errors(
    found: CalibrationEstimate, term: PoseTerm, others: FloatArray | None
) -> tuple[CalibrationEstimate, PoseErrors | None]:
    """Widen the intervals by errors of the flange's poses that change smoothly with these.

    Errors of a constant size that go along are the same as a rotation of base or camera: the
    residuals cannot show them. They are assumed to be as large as those that the residuals show.

    Args:
        others: (n, 6, further) derivatives of the residuals by other errors.
    """
    fit = found.fit
    kept = fit.kept[0]
    poses = predicted_poses(fit.problem, fit.state)[term.rows]
    own = _by_flange(fit, term)
    in_base = _in_base(poses)
    features = _features(poses[kept], poses)
    best = None
    # Joints near the base turn the flange about axes of the base that change with its position, and
    # those near the flange about its own axes, which change with its orientation.
    for moved, part in ((in_base, _PARTS[0]), (None, _PARTS[1]), (None, slice(0, 6))):
        by_error = own if moved is None else own @ moved
        columns = _times_features(by_error, features[:, part])
        smooth = columns.shape[2]
        columns = columns if others is None else np.concatenate([others, columns], axis=2)
        tested = free_columns(fit, fit.jacobian, _whitened(fit, columns), _residuals(fit))
        if best is None or tested.probability < best[0].probability:
            field = features[:, part] @ tested.step[-smooth:].reshape(6, -1).T
            if moved is not None:
                field = np.einsum("nab,nb->na", moved, field)
            best = tested, field[kept]
    assert best is not None
    tested, field = best
    probability = min(3.0 * tested.probability, 1.0)
    if probability > _CHANCE:
        return found, None
    field -= field.mean(axis=0)
    translation, rotation = (float(np.sqrt(np.mean(field[:, part] ** 2))) for part in _PARTS)
    spread = np.repeat([translation, rotation], 3)
    constant = np.zeros_like(found.covariance)
    for by_error in (own, own @ in_base):
        whitened = _whitened(fit, by_error)
        shifts = np.column_stack(
            [least_squares_step(fit.jacobian, whitened[:, axis]) for axis in range(6)]
        )
        constant += shifts @ np.diag(spread**2) @ shifts.T
    covariance = widened(
        found.covariance, np.outer(tested.shift, tested.shift) + tested.covariance + constant
    )
    return replace(found, covariance=covariance), PoseErrors(
        "flange",
        probability,
        tested.removes,
        "the residuals follow the flange's pose: its poses are wrong by about "
        f"{1e3 * translation:.2g} mm and {1e3 * rotation:.2g} mrad that change with the pose, as "
        "with wrong joint zeros or links in the controller",
        "give robot: with columns joint.NAME, and estimate joint_zeros",
    )


def _with_columns(
    found: CalibrationEstimate, *columns: FloatArray
) -> tuple[CalibrationEstimate, FurtherColumns | None]:
    """Widen the intervals by further errors, if the residuals show them.

    Args:
        columns: for each term, (n, residuals, further) derivatives by the errors.
    """
    fit = found.fit
    tested = free_columns(fit, fit.jacobian, _whitened(fit, *columns), _residuals(fit))
    if tested.probability > _CHANCE:
        return found, None
    wider = np.outer(tested.shift, tested.shift) + tested.covariance
    return replace(found, covariance=widened(found.covariance, wider)), tested


def _depth(term: PoseTerm) -> FloatArray:
    """Return (n, 6, 1) derivatives of the residuals by a factor of the measured depths."""
    slopes = np.zeros((len(term.rows), 6, 1))
    slopes[:, 2, 0] = -term.measured[:, 2, 3]
    return slopes


def _by_flange(fit: Fit, term: PoseTerm) -> FloatArray:
    """Return (n, 6, 6) derivatives of the residuals by the flange's pose, in its own axes."""
    problem = fit.problem
    variables = Variables(problem.layout, fit.state, np.zeros(problem.layout.count))
    return term.by_flange(problem.flange(variables), variables)


def _features(used: FloatArray, poses: FloatArray) -> FloatArray:
    """Return (n, 6) positions and rotation vectors relative to the mean pose, of unit scatter.

    Args:
        used: (m, 4, 4) poses that give mean and scatter.
    """
    middle = Rotation.from_matrix(used[:, :3, :3]).mean()

    def values(of: FloatArray) -> FloatArray:
        turns = (middle.inv() * Rotation.from_matrix(of[:, :3, :3])).as_rotvec()
        return np.concatenate([of[:, :3, 3], turns], axis=1)

    centre, scatter = values(used).mean(axis=0), values(used).std(axis=0)
    return np.asarray((values(poses) - centre) / np.maximum(scatter, 1e-9))


def _times_features(by_error: FloatArray, features: FloatArray) -> FloatArray:
    """Return (n, 6, 6 f) derivatives by errors that are linear in (n, f) features."""
    product = np.einsum("nab,nf->nabf", by_error, features)
    return np.asarray(product.reshape(len(features), 6, -1))


def _in_base(poses: FloatArray) -> FloatArray:
    """Return (n, 6, 6): pose of the base, m and rad, to the flange's error in its own axes."""
    moved = np.zeros((len(poses), 6, 6))
    back = np.swapaxes(poses[:, :3, :3], 1, 2)
    moved[:, :3, :3] = moved[:, 3:, 3:] = back
    for axis in range(3):
        turned = np.cross(np.eye(3)[axis], poses[:, :3, 3])
        moved[:, :3, 3 + axis] = np.einsum("nab,nb->na", back, turned)
    return moved


def _whitened(fit: Fit, *columns: FloatArray) -> FloatArray:
    """Return (m, further) derivatives over their noise, 0 for outliers and priors.

    Args:
        columns: for each term, (n, residuals, further) derivatives.
    """
    rows = []
    for term, kept, of_term in zip(fit.problem.terms, fit.kept, columns, strict=True):
        sizes = np.array([fit.noise[name] for name in term.noise])
        weighted = of_term * (kept[:, None] / sizes)[:, :, None]
        rows.append(weighted.reshape(-1, of_term.shape[2]))
    priors = np.zeros((len(fit.jacobian) - sum(map(len, rows)), columns[0].shape[2]))
    return np.vstack([*rows, priors])


def _residuals(fit: Fit) -> FloatArray:
    """Return (m,) residuals over their noise, 0 for outliers, and those of priors."""
    rows = []
    for term, kept, residuals in zip(fit.problem.terms, fit.kept, fit.residuals, strict=True):
        sizes = np.array([fit.noise[name] for name in term.noise])
        rows.append((residuals * (kept[:, None] / sizes)).ravel())
    return np.concatenate([*rows, prior_values(fit.problem, fit.state)])
