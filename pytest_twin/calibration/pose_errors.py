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
from scipy.special import softmax

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.further_columns import (
    FEWEST_DEGREES,
    FurtherColumns,
    free_columns,
    widened,
)
from pytest_twin.calibration.parameters import Variables
from pytest_twin.calibration.records import CalibrationEstimate
from pytest_twin.calibration.smooth_errors import SmoothErrors, smooth_errors
from pytest_twin.calibration.solve import Fit, prior_values
from pytest_twin.calibration.terms import PivotTerm, PointTerm, PoseTerm, by_flange
from pytest_twin.metrics.pose import rigid

_CHANCE = 0.01
"""Significance level of each kind of error. A false one widens the intervals."""
_LEVER = 0.5
"""Distance of an axis that is wrong from the flange, relative to the reach: a rotation by an angle
moves the flange by the angle times this distance."""
_CONSTANT = 2.0
"""Size of constant errors relative to that of errors that change by one radian. A wrong joint zero
turns about one axis, so its constant part is larger than that of a random field. Of 32 arms with 45
poses, the worst missed by 3 half widths with 1.4 and by 2 with 2.2."""
_LEAST_REACH_M = 0.05
"""Smallest reach, m."""
_PARTS = (slice(0, 3), slice(3, 6))
"""Position and orientation in the columns of a pose's error."""


@dataclass(frozen=True)
class PoseErrors:
    """An error that repeats with the pose.

    Attributes:
        kind: ``depth``, ``scale``, ``flange`` or ``tool``.
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


@dataclass(frozen=True)
class TestedPoses:
    """Result of the tests for errors that repeat with the pose.

    Attributes:
        errors: those that the residuals show.
        added: (count, count) part of the covariance of the unknowns for errors of the flange's
            poses that the residuals do not exclude.
    """

    errors: tuple[PoseErrors, ...]
    added: FloatArray

    @classmethod
    def nothing(cls, count: int) -> TestedPoses:
        """Return the result where nothing is tested."""
        return cls((), np.zeros((count, count)))


def with_pose_errors(found: CalibrationEstimate) -> tuple[CalibrationEstimate, TestedPoses]:
    """Return the estimate with wider intervals if its errors follow the poses, and these errors.

    Depths in images and the positions of odometry are not tested. The flange's poses of a robot
    whose joint zeros are estimated are tested for compliance instead.
    """
    problem = found.fit.problem
    terms = problem.terms
    nothing = TestedPoses.nothing(problem.layout.count)
    if found.lost.any() or not terms or problem.is_odometry:
        return found, nothing
    errors: list[PoseErrors] = []
    others = None
    if all(isinstance(term, PointTerm) for term in terms):
        sizes = [-term.measured[:, :, None] for term in terms if isinstance(term, PointTerm)]
        found, scaled = _with_columns(found, *sizes)
        if scaled is not None:
            # Errors of a large factor to second order follow the poses too.
            return found, replace(nothing, errors=(_wrong_scale(scaled),))
    elif len(terms) == 1 and isinstance(terms[0], PoseTerm) and problem.observations.images is None:
        depth = _depth(terms[0])
        found, deep = _with_columns(found, depth)
        if deep is not None:
            others = _whitened(found.fit, depth)
            errors.append(_wrong_depth(deep))
    bends = all(isinstance(term, PivotTerm) for term in terms)
    if problem.layout.zeros and not bends:
        return found, replace(nothing, errors=tuple(errors))
    found, tested = _with_flange_errors(found, others, bends=bends)
    return found, replace(tested, errors=(*errors, *tested.errors))


def _wrong_depth(tested: FurtherColumns) -> PoseErrors:
    return PoseErrors(
        "depth",
        tested.probability,
        tested.removes,
        f"depths of camera_from_target are {1.0 + float(tested.step[-1]):.4f} times too small or "
        "too large: the focal length that measured them is probably wrong by this factor",
        "calibrate the camera's intrinsics, or give images",
    )


def _wrong_scale(tested: FurtherColumns) -> PoseErrors:
    return PoseErrors(
        "scale",
        tested.probability,
        tested.removes,
        f"positions of point.* fit the robot's motions {1.0 + float(tested.step[-1]):.4f} times as "
        "large: the tracker's scale or the robot's links are wrong by this factor",
        "measure a known length with the tracker, or give robot: and estimate geometry",
    )


def _with_flange_errors(
    found: CalibrationEstimate, others: FloatArray | None, *, bends: bool
) -> tuple[CalibrationEstimate, TestedPoses]:
    """Widen the intervals by errors of the flange's poses that change smoothly with these.

    Errors of a constant size that go along are the same as a rotation of base or camera: the
    residuals cannot show them. They are assumed to be as large as those that change by one radian.
    A tool that bends at a pivot, by its weight or by pressing down, looks to first order like a
    longer one. It is an error of its own, whose size the other errors do not limit.

    Args:
        others: (m, further) derivatives of the residuals by other errors, over their noise.
        bends: whether the tool may bend.
    """
    fit = found.fit
    layout, terms = fit.problem.layout, fit.problem.terms
    variables = Variables(layout, fit.state, np.zeros(layout.count))
    flange = fit.problem.flange(variables)
    poses = rigid(flange.rotation, flange.position)
    used = np.unique(np.concatenate([t.rows[k] for t, k in zip(terms, fit.kept, strict=True)]))
    residuals = _residuals(fit)
    count = len(residuals) - sum(
        int((~kept).sum()) * len(term.noise) for term, kept in zip(terms, fit.kept, strict=True)
    )
    slopes = fit.jacobian if others is None else np.hstack([fit.jacobian, others])
    added = np.zeros_like(found.covariance)
    if count - slopes.shape[1] < FEWEST_DEGREES:
        return found, TestedPoses((), added)
    of_terms = [(by_flange(term, flange, variables), term.rows) for term in terms]
    if bends:
        # Errors of the reported positions must not predict themselves: those that pivots give.
        for term, residual in zip(terms, fit.residuals, strict=True):
            poses[term.rows, :3, 3] -= residual
    alternatives = [] if layout.zeros else [_flange_fields(poses, used)]
    alternatives += [[_bending(poses)]] if bends else []
    shown: list[tuple[float, _Field, SmoothErrors]] = []
    for fields in alternatives:
        tested = [
            smooth_errors(slopes, _whitened(fit, *field.columns(of_terms)), residuals, count)
            for field in fields
        ]
        weights = softmax([one.evidence for one in tested])
        for field, one, weight in zip(fields, tested, weights, strict=True):
            added += weight * one.added[: layout.count, : layout.count]
            shown.append((one.probability * len(fields) * len(alternatives), field, one))
    found = replace(found, covariance=found.covariance + added)
    probability, field, best = min(shown, key=lambda one: one[0])
    if probability > _CHANCE:
        return found, TestedPoses((), added)
    translation, rotation = field.sizes(best.effects, used)
    if field.kind == "tool":
        words = (
            f"the tool bends by about {1e3 * translation:.2g} mm, as its weight or the force at "
            "its tip does",
            "press the tip less, or use a stiffer tool",
        )
    else:
        words = (
            "the residuals follow the flange's pose: its poses are wrong by about "
            f"{1e3 * translation:.2g} mm and {1e3 * rotation:.2g} mrad that change with the pose, "
            "as with wrong joint zeros or links in the controller",
            "give robot: with columns joint.NAME, and estimate joint_zeros",
        )
    error = PoseErrors(field.kind, probability, best.removes, *words)
    return found, TestedPoses((error,), added)


@dataclass(frozen=True)
class _Field:
    """Errors of the flange's pose that are linear in features of this pose.

    Attributes:
        kind: ``flange`` or ``tool``.
        parts: (rows, 6, e) from errors to displacements of the flange in its own axes, m and rad,
            and the (rows, f) features that each error is multiplied with.
    """

    kind: str
    parts: tuple[tuple[FloatArray, FloatArray], ...]

    def columns(self, of_terms: list[tuple[FloatArray, np.ndarray]]) -> list[FloatArray]:
        """Return for each term (n, columns, e f) derivatives of the residuals by the errors.

        Args:
            of_terms: (n, columns, 6) derivatives by the flange's pose, and (n,) rows.
        """
        return [
            np.concatenate(
                [
                    np.einsum("nab,nbe,nf->naef", by_pose, moves[rows], features[rows]).reshape(
                        *by_pose.shape[:2], -1
                    )
                    for moves, features in self.parts
                ],
                axis=2,
            )
            for by_pose, rows in of_terms
        ]

    def sizes(self, effects: FloatArray, used: np.ndarray) -> tuple[float, float]:
        """Root mean squares of what changes with the pose, m and rad, for (e f,) errors."""
        errors, start = np.zeros((len(used), 6)), 0
        for moves, features in self.parts:
            shape = moves.shape[2], features.shape[1]
            changing = features[used] - features[used].mean(axis=0)
            of_part = effects[start : start + shape[0] * shape[1]].reshape(shape)
            errors += np.einsum("nbe,ef,nf->nb", moves[used], of_part, changing)
            start += of_part.size
        translation, rotation = (float(np.sqrt(np.mean(errors[:, part] ** 2))) for part in _PARTS)
        return translation, rotation


def _flange_fields(poses: FloatArray, used: np.ndarray) -> list[_Field]:
    """Return errors of (rows, 4, 4) poses of the flange as alternatives; ``used`` rows are fitted.

    Joints near the base turn the flange about axes of the base that change with its position, and
    those near the flange about its own axes, which change with its orientation.
    """
    reach = max(float(np.median(np.linalg.norm(poses[used, :3, 3], axis=1))), _LEAST_REACH_M)
    middle = Rotation.from_matrix(poses[used, :3, :3]).mean()
    turns = (middle.inv() * Rotation.from_matrix(poses[:, :3, :3])).as_rotvec()
    changes = np.concatenate([poses[:, :3, 3] / reach, turns], axis=1)
    changes -= changes[used].mean(axis=0)
    constant = np.full((len(poses), 1), _CONSTANT)
    near_base, near_flange, everywhere = (
        np.hstack([constant, part]) for part in (changes[:, :3], changes[:, 3:], changes)
    )
    own = np.tile(np.diag(np.repeat([_LEVER * reach, 1.0], 3)), (len(poses), 1, 1))
    in_base = _in_base(poses) @ own
    return [
        _Field("flange", ((in_base, near_base),)),
        _Field("flange", ((own, near_flange),)),
        _Field("flange", ((own, everywhere), (in_base, everywhere))),
    ]


def _bending(poses: FloatArray) -> _Field:
    """Displacement of the flange that is linear in the base's downward direction in its axes."""
    moves = np.tile(np.eye(6)[:, :3], (len(poses), 1, 1))
    return _Field("tool", ((moves, -poses[:, 2, :3]),))


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
