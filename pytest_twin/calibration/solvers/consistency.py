"""Consistency of a hand-eye calibration with held-out poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.cameras.increments import inverse
from pytest_twin.calibration.solvers.algebraic import HandEye, Mount, mean_pose, solve_all


@dataclass(frozen=True)
class Scatter:
    """Scatter of the target's pose in the frame that it is fixed to.

    Attributes:
        translation: (n,) distances from the mean position, m.
        rotation: (n,) angles from the mean rotation, rad.
    """

    translation: FloatArray
    rotation: FloatArray

    @property
    def translation_rms(self) -> float:
        """Root mean square of the distances, m."""
        return float(np.sqrt(np.mean(self.translation**2)))

    @property
    def rotation_rms(self) -> float:
        """Root mean square of the angles, rad."""
        return float(np.sqrt(np.mean(self.rotation**2)))


def scatter(
    base_from_flange: FloatArray, camera_from_target: FloatArray, solved: HandEye, mount: Mount
) -> Scatter:
    """Scatter of the target's pose in the base (mount ``hand``) or on the flange (``world``).

    It depends on the camera's pose only, because the mean is subtracted.
    """
    poses = target_poses(base_from_flange, camera_from_target, solved, mount)
    mean = mean_pose(poses)
    turns = Rotation.from_matrix(mean[:3, :3].T @ poses[:, :3, :3]).magnitude()
    distances = np.linalg.norm(poses[:, :3, 3] - mean[:3, 3], axis=1)
    return Scatter(distances, np.asarray(turns, dtype=np.float64))


def target_poses(
    base_from_flange: FloatArray, camera_from_target: FloatArray, solved: HandEye, mount: Mount
) -> FloatArray:
    """(n, 4, 4) poses of the target in the frame that it is fixed to, one from each observation."""
    if mount == "hand":
        return base_from_flange @ solved.hand_eye @ camera_from_target
    return inverse(base_from_flange) @ solved.robot_world @ camera_from_target


def held_out_scatter(
    base_from_flange: FloatArray,
    camera_from_target: FloatArray,
    mount: Mount,
    held_out: np.ndarray,
    solve: Callable[[FloatArray, FloatArray, Mount], Mapping[str, HandEye]] = solve_all,
) -> Mapping[str, Scatter | str]:
    """Return each solver's scatter on held-out poses, or the reason why it failed.

    Args:
        base_from_flange: (n, 4, 4) m.
        camera_from_target: (n, 4, 4) m.
        mount: where the camera is mounted.
        held_out: indices of the poses that are held out.
        solve: function that returns a solution for each solver name.
    """
    seen = np.setdiff1d(np.arange(len(base_from_flange)), held_out)
    solved = solve(base_from_flange[seen], camera_from_target[seen], mount)
    return {
        name: one.failed
        or scatter(base_from_flange[held_out], camera_from_target[held_out], one, mount)
        for name, one in solved.items()
    }
