"""Normal equations of a bundle adjustment with camera, board and robot, and their noise.

The weights of the kinds of residuals are not known beforehand. The variances of corners, robot and
board are estimated from the squared residuals of each kind, divided by its redundancy (variance
components, Foerstner 1979).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.cameras.arm import Arm
from pytest_twin.calibration.cameras.elimination import BlockMatrix, Elimination, Step
from pytest_twin.calibration.cameras.increments import (
    apply_change,
    by_measured,
    difference,
    jacobian_by_first,
    jacobian_by_second,
    jacobian_of_inverse,
)
from pytest_twin.calibration.cameras.reprojection import Corners, reprojection_residuals
from pytest_twin.calibration.solvers.algebraic import Mount
from pytest_twin.metrics.pose import inverse

_HUBER = 2.5
"""Residuals beyond this many standard deviations enter the cost linearly. Huber's 1.345 is for 10 %
outliers; corners and robots have fewer."""


@dataclass(frozen=True)
class MeasurementNoise:
    """Standard deviations of the measurements; the defaults are typical values.

    Attributes:
        pixel: of each coordinate of a corner in the image, px.
        position: of each coordinate of the flange's position, m.
        orientation: of each coordinate of the flange's rotation vector, rad.
        board: of each coordinate of a corner's position on the board, m.
    """

    pixel: float = 0.3
    position: float = 5e-4
    orientation: float = 1e-3
    board: float = 1e-4

    @property
    def vector(self) -> FloatArray:
        """(4,) the values in the order of the attributes."""
        return np.array([self.pixel, self.position, self.orientation, self.board])


LEAST_NOISE = MeasurementNoise(0.01, 5e-6, 5e-6, 1e-5)
"""Lower bounds of the estimated noise, which exact synthetic data need."""


@dataclass(frozen=True)
class Unknowns:
    """Values of the unknowns.

    Attributes:
        hand_eye, robot_world: (4, 4), see ``HandEye``, m.
        intrinsics: (16,) in the order of ``NAMES``.
        camera_from_target: (n, 4, 4), m.
        board: (corners, 3) positions of the corners in the target's frame, in the unit of the
            drawing, m.
        arm: (k,) steps of joint zeros and link deviations from the arm's state, rad and m.
        scale: printed size of the board divided by that of the drawing.
    """

    hand_eye: FloatArray
    robot_world: FloatArray
    intrinsics: FloatArray
    camera_from_target: FloatArray
    board: FloatArray
    arm: FloatArray = field(default_factory=lambda: np.zeros(0))
    scale: float = 1.0


@dataclass(frozen=True)
class Model:
    """Measurements and free parameters of a bundle adjustment.

    The globals are the unknowns that all images share. Their order is: free intrinsics, hand-eye
    and robot-world (with a robot), the arm's own parameters, the scale of the board (if it is
    free).

    Attributes:
        base_from_flange: (n, 4, 4) m, or None.
        corners: corners of all images.
        mount: where the camera is mounted.
        free: indices of the free intrinsics.
        drawing: (corners, 3) corners of the board's drawing, m; None if the board is exact.
        arm: robot arm whose joint zeros or links are free; None if ``base_from_flange`` is given.
        size_tolerance: standard deviation of the board's printed size, relative to its drawing:
            0 for an exact size, infinite for an unknown one.
    """

    base_from_flange: FloatArray | None
    corners: Corners
    mount: Mount
    free: np.ndarray
    drawing: FloatArray | None
    arm: Arm | None = None
    size_tolerance: float = 0.0

    @property
    def intrinsics(self) -> np.ndarray:
        """Indices of the free intrinsics among the globals."""
        return np.arange(len(self.free))

    @property
    def transforms(self) -> np.ndarray:
        """Indices of hand-eye and robot-world among the globals."""
        return len(self.free) + np.arange(0 if self.base_from_flange is None else 12)

    @property
    def own(self) -> np.ndarray:
        """Indices of the arm's own parameters among the globals."""
        before = len(self.free) + len(self.transforms)
        return before + np.arange(0 if self.arm is None else self.arm.count)

    @property
    def scale(self) -> np.ndarray:
        """Index of the board's scale among the globals; empty without a robot or if it is exact."""
        before = len(self.free) + len(self.transforms) + len(self.own)
        is_free = self.base_from_flange is not None and self.size_tolerance > 0.0
        return before + np.arange(int(is_free))

    @property
    def count(self) -> int:
        """Number of globals."""
        return len(self.free) + len(self.transforms) + len(self.own) + len(self.scale)

    def prior(self, unknowns: Unknowns) -> tuple[FloatArray, FloatArray]:
        """(count,) inverse variances of the priors of the globals, and deviations from them."""
        precision, values = np.zeros(self.count), np.zeros(self.count)
        if self.arm is not None:
            precision[self.own] = self.arm.precision
            values[self.own] = self.arm.values(unknowns.arm)
        if len(self.scale):
            precision[self.scale] = self.size_tolerance**-2
            values[self.scale] = unknowns.scale - 1.0
        return precision, values

    def robot(self, unknowns: Unknowns) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(k, 6) residuals of the robot's poses, and Jacobians by globals and by target poses."""
        if self.base_from_flange is None:
            return np.zeros((0, 6)), np.zeros((0, 6, 0)), np.zeros((0, 6, 6))
        seen, by_pose = unknowns.camera_from_target, np.eye(6)
        if self.mount == "hand":
            seen, by_pose = inverse(seen), jacobian_of_inverse(seen)
        world = unknowns.robot_world
        at, back = world @ seen, inverse(unknowns.hand_eye)
        reported, by_own = self.base_from_flange, np.zeros((len(at), 6, 0))
        if self.arm is not None:
            reported, by_own = self.arm.flange(unknowns.arm)
        predicted = at @ back
        residual, slope = difference(reported, predicted)
        by_own = by_measured(reported, predicted, slope) @ by_own
        through = slope @ jacobian_by_first(at, np.broadcast_to(back, at.shape))
        by_world = through @ jacobian_by_first(np.broadcast_to(world, seen.shape), seen)
        by_hand_eye = slope @ jacobian_by_second(at) @ jacobian_of_inverse(unknowns.hand_eye)
        by_transforms = np.concatenate([by_hand_eye, by_world, by_own], axis=2)
        return residual, by_transforms, through @ jacobian_by_second(world) @ by_pose


@dataclass(frozen=True)
class Equations:
    """Normal equations at given unknowns.

    Attributes:
        pixels, robot, deviation: residuals of corners (m, 2), px, of robot poses (k, 6), m and rad,
            and of the board (corners, 3), m.
        pixel_weights, robot_weights: (m,) and (k,) weights of Huber's function.
        robot_slopes: Jacobians of the robot residuals, (k, 6, 6) by the target's pose and
            (k, 6, count) by the globals, divided by the noise.
        right: gradient of half the cost.
    """

    cost: float
    pixels: FloatArray
    robot: FloatArray
    deviation: FloatArray
    pixel_weights: FloatArray
    robot_weights: FloatArray
    robot_slopes: tuple[FloatArray, FloatArray]
    matrix: BlockMatrix
    right: Step

    @cached_property
    def solver(self) -> Elimination:
        """The matrix with target poses or corners eliminated."""
        return Elimination(self.matrix)


def linearize(model: Model, unknowns: Unknowns, noise: MeasurementNoise) -> Equations:
    """Return the weighted normal equations at given values of the unknowns."""
    corners = replace(model.corners, points=unknowns.scale * unknowns.board[model.corners.ids])
    pixels, by_pose, by_intrinsics = reprojection_residuals(
        unknowns.intrinsics, unknowns.camera_from_target, corners
    )
    robot, by_transforms, robot_by_pose = model.robot(unknowns)
    by_globals = np.zeros((len(pixels), 2, model.count))
    by_globals[:, :, model.intrinsics] = by_intrinsics[:, :, model.free]
    by_corner = np.zeros((len(pixels), 2, 0))
    deviation = np.zeros_like(unknowns.board)
    if model.drawing is not None or len(model.scale):
        turns = unknowns.camera_from_target[corners.image][:, :3, :3]
        by_place = by_pose[:, :, :3] @ turns
        if len(model.scale):
            places = unknowns.board[corners.ids]
            by_globals[:, :, model.scale] = by_place @ places[:, :, None]
        if model.drawing is not None:
            deviation = unknowns.board - model.drawing
            by_corner = unknowns.scale * by_place
    robot_by_globals = np.zeros((len(robot), 6, model.count))
    robot_by_globals[:, :, np.r_[model.transforms, model.own]] = by_transforms
    precision, values = model.prior(unknowns)

    # The two coordinates of a corner, or the six of a pose, get one common weight.
    scale = np.repeat([1.0 / noise.position, 1.0 / noise.orientation], 3)
    pixel_cost, pixel_weight = _huber(np.mean((pixels / noise.pixel) ** 2, axis=1))
    robot_cost, robot_weight = _huber(np.mean((robot * scale) ** 2, axis=1))
    cost = 2.0 * pixel_cost.sum() + 6.0 * robot_cost.sum()
    cost += np.sum((deviation / noise.board) ** 2) + np.sum(precision * values**2)

    white = (np.sqrt(pixel_weight) / noise.pixel)[:, None, None]
    robot_white = np.sqrt(robot_weight)[:, None, None] * scale[None, :, None]
    ap, ag, ac = white * by_pose, white * by_globals, white * by_corner
    ep = white[..., 0] * pixels
    rp, rg = robot_white * robot_by_pose, robot_white * robot_by_globals
    er = robot_white[..., 0] * robot

    images, starts, ids = model.corners.images, model.corners.starts, model.corners.ids
    back = np.swapaxes(ap, 1, 2)
    pose_block = np.add.reduceat(back @ ap, starts)
    pose_right = np.add.reduceat((back @ ep[..., None])[..., 0], starts)
    coupling = np.add.reduceat(np.swapaxes(ag, 1, 2) @ ap, starts)
    shared = _normal_matrix(ag) + _normal_matrix(rg) + np.diag(precision)
    right = np.einsum("mcg,mc->g", ag, ep) + np.einsum("mcg,mc->g", rg, er) + precision * values
    if len(robot):
        pose_block += np.swapaxes(rp, 1, 2) @ rp
        pose_right += (np.swapaxes(rp, 1, 2) @ er[..., None])[..., 0]
        coupling += np.swapaxes(rg, 1, 2) @ rp

    free_corners = 0 if model.drawing is None else len(model.drawing)
    corner_block = np.zeros((free_corners, 3, 3))
    corner_right = np.zeros((free_corners, 3))
    shared_corners = np.zeros((free_corners, 3, model.count))
    poses_corners = np.zeros((images, 6, free_corners, 3))
    if free_corners:
        corner_back = np.swapaxes(ac, 1, 2)
        np.add.at(corner_block, ids, corner_back @ ac)
        np.add.at(corner_right, ids, (corner_back @ ep[..., None])[..., 0])
        np.add.at(shared_corners, ids, corner_back @ ag)
        # An image shows each corner once.
        poses_corners[model.corners.image, :, ids, :] = back @ ac
        corner_block += np.eye(3) / noise.board**2
        corner_right += deviation / noise.board**2
    matrix = BlockMatrix(
        shared,
        pose_block,
        corner_block,
        coupling.transpose(1, 0, 2).reshape(model.count, -1),
        shared_corners.reshape(-1, model.count).T,
        poses_corners.reshape(6 * images, 3 * free_corners),
    )
    return Equations(
        float(cost), pixels, robot, deviation, pixel_weight, robot_weight, (rp, rg),
        matrix, Step(right, pose_right, corner_right),
    )  # fmt: skip


def apply_step(model: Model, at: Unknowns, step: Step) -> Unknowns:
    """Return the unknowns after a step."""
    move = step.shared
    intrinsics = at.intrinsics.copy()
    intrinsics[model.free] += move[model.intrinsics]
    moved = replace(
        at,
        intrinsics=intrinsics,
        camera_from_target=apply_change(at.camera_from_target, step.poses),
        board=at.board if model.drawing is None else at.board + step.corners,
        scale=at.scale + float(move[model.scale].sum()),
        arm=at.arm + move[model.own] if len(model.own) else at.arm,
    )
    if not len(model.transforms):
        return moved
    turns = move[model.transforms]
    return replace(
        moved,
        hand_eye=apply_change(at.hand_eye, turns[:6]),
        robot_world=apply_change(at.robot_world, turns[6:]),
    )


def noise_of(model: Model, unknowns: Unknowns, noise: MeasurementNoise) -> MeasurementNoise:
    """Estimate the noise of each kind of residual from its squares and its redundancy.

    The unknowns use up as many degrees of freedom as there are unknowns. Each kind of residual
    uses the trace of its part of the normal matrix times the covariance.
    """
    equations = linearize(model, unknowns, noise)
    covariance = equations.solver.covariance

    def size(squares: float, count: float, taken: float, least: float) -> float:
        return max(float(np.sqrt(squares / max(count - taken, 0.02 * count))), least)

    precision, _ = model.prior(unknowns)
    taken = float(model.count + 6 * model.corners.images + covariance.corners.size / 3)
    taken -= float(precision @ np.diag(covariance.shared))
    found = noise
    if model.base_from_flange is not None:
        by_pose, by_globals = equations.robot_slopes
        cross = covariance.shared_poses.reshape(model.count, -1, 6).transpose(1, 0, 2)
        each = (
            np.einsum("kci,kij,kcj->c", by_pose, covariance.poses, by_pose, optimize=True)
            + np.einsum("kcg,gh,kch->c", by_globals, covariance.shared, by_globals, optimize=True)
            + 2.0 * np.einsum("kcg,kgi,kci->c", by_globals, cross, by_pose, optimize=True)
        )
        taken -= float(each.sum())
        weights = equations.robot_weights
        sums = np.sum(weights[:, None] * equations.robot**2, axis=0)
        count = 3.0 * float(weights.sum())
        found = replace(
            found,
            position=size(sums[:3].sum(), count, each[:3].sum(), LEAST_NOISE.position),
            orientation=size(sums[3:].sum(), count, each[3:].sum(), LEAST_NOISE.orientation),
        )
    if model.drawing is not None:
        known = float(np.einsum("cii->", covariance.corners)) / noise.board**2
        taken -= known
        squares, count = float(np.sum(equations.deviation**2)), float(model.drawing.size)
        found = replace(found, board=size(squares, count, known, LEAST_NOISE.board))
    weights = equations.pixel_weights
    squares = float(np.sum(weights[:, None] * equations.pixels**2))
    return replace(found, pixel=size(squares, 2 * weights.sum(), taken, LEAST_NOISE.pixel))


def _normal_matrix(slopes: FloatArray) -> FloatArray:
    rows = slopes.reshape(-1, slopes.shape[2])
    return np.asarray(rows.T @ rows, dtype=np.float64)


def _huber(squares: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Costs and weights by Huber's function, from squared residuals in standard deviations."""
    size = np.asarray(np.sqrt(squares), dtype=np.float64)
    far = size > _HUBER
    cost = np.where(far, 2.0 * _HUBER * size - _HUBER**2, squares)
    weight = np.where(far, _HUBER / np.maximum(size, _HUBER), 1.0)
    return np.asarray(cost, dtype=np.float64), np.asarray(weight, dtype=np.float64)
