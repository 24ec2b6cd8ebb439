"""Estimate the pose of a target from one image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.boards.detection import Detection
from pytest_twin.calibration.boards.opencv import opencv
from pytest_twin.calibration.cameras.increments import apply_change
from pytest_twin.calibration.cameras.intrinsics import Intrinsics
from pytest_twin.calibration.cameras.reprojection import corners_of, reprojection_residuals
from pytest_twin.metrics.pose import rigid

_STEPS = 20
"""Largest number of Levenberg-Marquardt steps."""
_SETTLED = 1e-10
"""Relative change of the cost below which the steps end."""
AMBIGUOUS = 1.5
"""Ratio of reprojection errors below which the second-best pose may be the right one. A flat target
that is far away or parallel to the image looks the same in both poses."""


@dataclass(frozen=True)
class TargetPose:
    """Pose of a target in one image.

    Attributes:
        camera_from_target: (4, 4) transform from the target's frame to the camera's, m.
        information: (6, 6) inverse covariance for a pixel noise of 1 px: x, y, z, then the
            rotation vector, both in the camera's axes. Divide by the actual variance in px^2.
        rms: reprojection error, px, root mean square over coordinates.
        ambiguity: RMS error of the second-best pose divided by ``rms``; infinite without one.
    """

    camera_from_target: FloatArray
    information: FloatArray
    rms: float
    ambiguity: float = np.inf


def target_pose(detection: Detection, intrinsics: Intrinsics) -> TargetPose | None:
    """Return the pose with the smallest reprojection error; None if none is found.

    A flat target has two poses with similar images (Collins, Bartoli: Infinitesimal plane-based
    pose estimation, 2014). Both are refined, and the better one is returned.
    """
    cv2 = opencv()
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            detection.board_points,
            detection.pixels,
            intrinsics.matrix,
            intrinsics.distortion,
            flags=cv2.SOLVEPNP_IPPE,
        )
    except cv2.error:
        return None
    found = []
    for turn, shift in zip(turns, shifts, strict=True):
        pose = rigid(Rotation.from_rotvec(turn.ravel()).as_matrix(), shift.ravel())
        if np.isfinite(pose).all() and pose[2, 3] > 0.0:
            refined = refine_pose(detection, intrinsics, pose)
            if refined is not None:
                found.append(refined)
    if not found:
        return None
    found.sort(key=lambda one: one.rms)
    best = found[0]
    if len(found) < 2 or _are_same(best, found[1]):
        return best
    ratio = found[1].rms / max(best.rms, 1e-9)
    return TargetPose(best.camera_from_target, best.information, best.rms, ratio)


def refine_pose(
    detection: Detection, intrinsics: Intrinsics, start: FloatArray
) -> TargetPose | None:
    """Return the pose of least reprojection error near ``start``; None if the search fails."""
    corners = corners_of([detection])
    pose, damping = start[None], 1e-6
    residual, by_pose, _ = reprojection_residuals(intrinsics.vector, pose, corners)
    cost = float(np.sum(residual**2))
    for _ in range(_STEPS):
        rows = by_pose.reshape(-1, 6)
        normal = rows.T @ rows
        damped = normal + damping * np.diag(np.diag(normal))
        try:
            step = -np.asarray(np.linalg.solve(damped, rows.T @ residual.ravel()), dtype=float)
        except np.linalg.LinAlgError:
            return None
        tried = apply_change(pose, step[None])
        new, new_by_pose, _ = reprojection_residuals(intrinsics.vector, tried, corners)
        new_cost = float(np.sum(new**2))
        if not np.isfinite(new_cost) or new_cost > cost:
            damping = max(damping, 1e-6) * 10.0
            if damping > 1e6:
                break
            continue
        settled = cost - new_cost <= _SETTLED * cost
        pose, residual, by_pose, cost = tried, new, new_by_pose, new_cost
        damping *= 0.1
        if settled:
            break
    rows = by_pose.reshape(-1, 6)
    if not np.isfinite(rows).all() or pose[0, 2, 3] <= 0.0:
        return None
    return TargetPose(pose[0], rows.T @ rows, float(np.sqrt(cost / residual.size)))


def _are_same(one: TargetPose, other: TargetPose) -> bool:
    difference = one.camera_from_target[:3, :3].T @ other.camera_from_target[:3, :3]
    return bool(Rotation.from_matrix(difference).magnitude() < 1e-3)
