"""Camera and hand-eye calibration by least squares on reprojection errors (bundle adjustment).

The unknowns are the free intrinsics, the pose of the target in each image and the positions of the
board's corners. With a robot, the hand-eye and robot-world transforms are unknowns too. The
residuals are the reprojection errors of the corners, the differences between the reported and the
predicted flange poses, and the deviations of the board from its drawing. If robot or board were
assumed exact, their errors would bias the intrinsics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.boards.detection import Detection
from pytest_twin.calibration.cameras.arm import Arm
from pytest_twin.calibration.cameras.intrinsics import NAMES
from pytest_twin.calibration.cameras.normal_equations import (
    Equations,
    MeasurementNoise,
    Model,
    Unknowns,
    apply_step,
    linearize,
    noise_of,
)
from pytest_twin.calibration.cameras.reprojection import corners_of
from pytest_twin.calibration.solvers.algebraic import HandEye, Mount
from pytest_twin.time_limit import is_over

FEWEST_IMAGES_FOR_BOARD = 8
"""Smallest number of images for which the board's deviations from its drawing are estimated. With
fewer images, noise of the corners would be attributed to the board."""

_STEPS, _ROUNDS = 60, 30
"""Largest number of Levenberg-Marquardt steps, and of rounds between which the noise is
estimated."""
_SETTLED, _ROUND_SETTLED = 1e-6, 0.03
"""Relative change of the cost below which the steps end, and of the noise below which the rounds
end."""


@dataclass(frozen=True)
class Bundle:
    """Result of the bundle adjustment.

    Attributes:
        solved: hand-eye and robot-world transforms; without a robot those of the start.
        intrinsics: (16,) in the order of ``NAMES``.
        free: names of the intrinsics that were estimated.
        camera_from_target: (n, 4, 4) pose of the target in each image, m.
        board: (corners, 3) positions of the corners in the target's frame, in the unit of the
            drawing, m.
        scale: printed size of the board divided by that of the drawing; 1 if it was assumed exact.
        scale_std: standard deviation of ``scale``; 0 if it was assumed exact.
        covariance: covariance of the 12 coordinates of hand-eye and robot-world (each x, y, z, then
            the rotation vector, in the axes of the parent; absent without a robot), of the arm's
            own parameters, of the scale (absent if exact), then of the free intrinsics.
        degrees: degrees of freedom of the noise estimate.
        noise: standard deviations of corners, robot and board.
        residuals: (m, 2) predicted minus detected corners, px.
        image: (m,) index of the image of each corner.
        robot: (n, 6) error of the robot's pose in the flange's axes: m, then rad.
        weights: (n,) robust weight of each robot pose; 1 for an inlier.
        is_board_estimated: whether the board's corners were estimated.
        arm: (k,) steps of the arm's own parameters, rad and m.
    """

    solved: HandEye
    intrinsics: FloatArray
    free: tuple[str, ...]
    camera_from_target: FloatArray
    board: FloatArray
    scale: float
    scale_std: float
    covariance: FloatArray
    degrees: float
    noise: MeasurementNoise
    residuals: FloatArray
    image: np.ndarray
    robot: FloatArray
    weights: FloatArray
    is_board_estimated: bool
    arm: FloatArray

    @property
    def reprojection_rms(self) -> float:
        """Reprojection error, px, root mean square over coordinates."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    def on_board(self, detection: Detection) -> Detection:
        """Return a detection with the estimated positions of the corners on the board."""
        return replace(detection, board_points=self.board[detection.corner_ids])


@dataclass(frozen=True, slots=True)
class KnownNoise:
    """Noise that is held (``is_exact``) or that the estimation of the noise starts from."""

    value: MeasurementNoise
    is_exact: bool = True


@dataclass(frozen=True)
class Robot:
    """Robot that carries the camera or the target.

    Attributes:
        base_from_flange: (n, 4, 4) as the robot reports them, m.
        arm: robot arm whose joint zeros or link deviations are estimated too.
        size_tolerance: standard deviation of the board's printed size, relative to its drawing;
            above 0 the size is estimated too.
    """

    base_from_flange: FloatArray
    mount: Mount
    arm: Arm | None = None
    size_tolerance: float = 0.0


def bundle(
    robot: Robot | None,
    detections: Sequence[Detection],
    start: Unknowns,
    free: Sequence[str] = (),
    *,
    noise: KnownNoise | None = None,
) -> Bundle:
    """Return the least-squares estimate from images and, with a robot, from its flange poses.

    Args:
        robot: the robot; None for images alone.
        detections: (n) usable detections.
        start: initial camera; its board is the drawing.
        free: intrinsics that are estimated.
        noise: known standard deviations; by default they are estimated.

    Raises:
        numpy.linalg.LinAlgError: the images and poses do not determine the unknowns.
    """
    # With few images the board is fixed at its drawing.
    exact_board = len(detections) < FEWEST_IMAGES_FOR_BOARD
    arm = None if robot is None else robot.arm
    model = Model(
        None if robot is None else robot.base_from_flange,
        corners_of(detections),
        "hand" if robot is None else robot.mount,
        np.array([NAMES.index(name) for name in free], dtype=int),
        None if exact_board else start.board,
        arm,
        0.0 if robot is None else robot.size_tolerance,
    )
    if arm is not None:
        start = replace(start, arm=np.zeros(arm.count))
    unknowns, sizes = start, MeasurementNoise() if noise is None else noise.value
    for _ in range(_ROUNDS):
        unknowns = _minimize(model, unknowns, sizes)
        if noise is not None and noise.is_exact:
            break
        new = noise_of(model, unknowns, sizes)
        change = max(abs(np.log(new.vector / sizes.vector)))
        sizes = new
        if change < _ROUND_SETTLED or is_over():
            break
    equations = linearize(model, unknowns, sizes)
    parameters = np.r_[model.transforms, model.own, model.scale, model.intrinsics]
    covariance = equations.solver.covariance.shared[np.ix_(parameters, parameters)]
    return Bundle(
        HandEye(unknowns.hand_eye, unknowns.robot_world),
        unknowns.intrinsics,
        tuple(free),
        unknowns.camera_from_target,
        unknowns.board,
        unknowns.scale,
        float(np.sqrt(equations.solver.covariance.shared[model.scale, model.scale].sum())),
        covariance,
        _degrees(model),
        sizes,
        equations.pixels,
        model.corners.image,
        equations.robot,
        equations.robot_weights,
        not exact_board,
        unknowns.arm,
    )


def _degrees(model: Model) -> float:
    """Degrees of freedom of the residuals that limit the accuracy: the robot's if there is one."""
    if model.base_from_flange is not None:
        return float(max(6 * len(model.base_from_flange) - 12 - len(model.own), 1))
    corners = 2 * len(model.corners.pixels) - 6 * model.corners.images - len(model.free)
    return float(max(corners, 1))


def _minimize(model: Model, unknowns: Unknowns, noise: MeasurementNoise) -> Unknowns:
    """Return the unknowns at the nearest local minimum of the cost (Levenberg-Marquardt)."""
    equations: Equations = linearize(model, unknowns, noise)
    damping = 1e-6
    for _ in range(_STEPS):
        tried = apply_step(model, unknowns, equations.solver.step(equations.right, damping))
        new = linearize(model, tried, noise)
        if not np.isfinite(new.cost) or new.cost > equations.cost:
            damping *= 10.0
            if damping > 1e8:
                break
            continue
        settled = equations.cost - new.cost <= _SETTLED * equations.cost
        unknowns, equations = tried, new
        damping = max(damping / 10.0, 1e-9)
        if settled or is_over():
            break
    return unknowns
