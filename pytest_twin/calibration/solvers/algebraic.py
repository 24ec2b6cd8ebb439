"""OpenCV's algebraic solvers of hand-eye and robot-world calibration behind one interface."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.boards.opencv import opencv
from pytest_twin.metrics.pose import inverse, rigid

Mount = Literal["hand", "world"]

HAND_EYE = ("tsai", "park", "horaud", "andreff", "daniilidis")
"""Solvers of AX = XB. They find one transform; the other is a mean over the poses."""

ROBOT_WORLD = ("shah", "li")
"""Solvers of AX = ZB: they find both transforms."""

FEWEST_POSES = 3
"""Smallest number of poses: two motions about different axes determine AX = XB (Tsai and Lenz
1989)."""

MOST_POSES = 120
"""Largest number of poses for a solver; from more, an evenly spaced subset is used. OpenCV combines
each pose with each other, which takes 2 s for 400 poses."""

_NOT_A_ROTATION = 1e-3
"""Largest deviation of a rotation from orthonormality. OpenCV's are below 1e-6, or far above."""


@dataclass(frozen=True)
class HandEye:
    """Hand-eye and robot-world transforms, or the reason why there are none.

    Attributes:
        hand_eye: (4, 4) pose in the flange of the body that it carries: the camera (mount
            ``hand``) or the target (``world``), m.
        robot_world: (4, 4) pose in the base of the fixed body: the target (``hand``) or the
            camera (``world``), m.
        failed: reason why the solver failed; empty if it did not.
    """

    hand_eye: FloatArray
    robot_world: FloatArray
    failed: str = ""


def solve_all(
    base_from_flange: FloatArray, camera_from_target: FloatArray, mount: Mount
) -> Mapping[str, HandEye]:
    """Return the result of each algebraic solver, by its name.

    Args:
        base_from_flange: (n, 4, 4) m.
        camera_from_target: (n, 4, 4) transform from the target's frame to the camera's, m.
        mount: ``hand`` where the flange carries the camera, ``world`` where it carries the target.
    """
    # For a fixed camera the same equation holds for the inverse poses of the flange, with the two
    # unknowns exchanged.
    flange = base_from_flange if mount == "hand" else inverse(base_from_flange)
    found = {}
    for name in (*HAND_EYE, *ROBOT_WORLD):
        with np.errstate(all="ignore"):  # numbers that are not finite are a failed solver
            one = _solve(name, flange, camera_from_target)
        if mount == "world":
            one = HandEye(one.robot_world, one.hand_eye, one.failed)
        found[name] = one
    return found


def solver_of_poses(name: str) -> Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Return a solver of ``flange @ mounted = world @ seen`` by its name.

    It takes (n, 4, 4) ``flange`` and ``seen`` and returns (4, 4) ``mounted`` and ``world``, m. It
    raises ``ValueError`` if it finds no solution.
    """

    def solve(flange: FloatArray, seen: FloatArray) -> tuple[FloatArray, FloatArray]:
        with np.errstate(all="ignore"):
            found = _solve(name, flange, inverse(seen))
        if found.failed:
            raise ValueError(found.failed)
        return found.hand_eye, found.robot_world

    return solve


def _solve(name: str, flange: FloatArray, camera_from_target: FloatArray) -> HandEye:
    """Return one solver's transforms for a camera on the flange."""
    nothing = np.full((4, 4), np.nan)
    if len(flange) < FEWEST_POSES:
        return HandEye(nothing, nothing, f"needs {FEWEST_POSES} poses")
    if len(flange) > MOST_POSES:
        chosen = np.linspace(0, len(flange) - 1, MOST_POSES).astype(int)
        flange, camera_from_target = flange[chosen], camera_from_target[chosen]
    cv2 = opencv()
    try:
        if name in HAND_EYE:
            # OpenCV takes a fifth positional argument for an output and ignores it silently: the
            # method must be named.
            turn, shift = cv2.calibrateHandEye(
                *_parts(flange),
                *_parts(camera_from_target),
                method=getattr(cv2, f"CALIB_HAND_EYE_{name.upper()}"),
            )
            hand_eye = _transform(turn, shift)
            robot_world = mean_pose(flange @ hand_eye @ camera_from_target)
        else:
            turn, shift, other_turn, other_shift = cv2.calibrateRobotWorldHandEye(
                *_parts(camera_from_target),
                *_parts(inverse(flange)),
                method=getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name.upper()}"),
            )
            robot_world = inverse(_transform(turn, shift))
            hand_eye = inverse(_transform(other_turn, other_shift))
    except (cv2.error, ValueError, np.linalg.LinAlgError) as error:
        return HandEye(nothing, nothing, f"the solver failed: {error}")
    for transform in (hand_eye, robot_world):
        if problem := _not_rigid(transform):
            return HandEye(nothing, nothing, problem)
    return HandEye(hand_eye, robot_world)


def mean_pose(poses: FloatArray) -> FloatArray:
    """(4, 4) mean of (n, 4, 4) poses: mean position and chordal mean rotation."""
    return rigid(
        Rotation.from_matrix(poses[:, :3, :3]).mean().as_matrix(), poses[:, :3, 3].mean(axis=0)
    )


def _parts(poses: FloatArray) -> tuple[Any, Any]:
    return list(poses[:, :3, :3]), list(poses[:, :3, 3])


def _transform(rotation: Any, position: Any) -> FloatArray:
    return rigid(rotation, np.ravel(position))


def _not_rigid(transform: FloatArray) -> str:
    """Reason why a matrix is no rigid transform; empty if it is one."""
    if not np.isfinite(transform).all():
        return "the solver returned numbers that are not finite"
    rotation = transform[:3, :3]
    off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if off > _NOT_A_ROTATION or np.linalg.det(rotation) < 0.0:
        return f"the solver returned a matrix that is no rotation (off by {off:.2g})"
    return ""
