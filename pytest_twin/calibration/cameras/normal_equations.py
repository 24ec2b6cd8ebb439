"""Normal equations of a bundle adjustment with camera, board and robot, and their noise.

The weights of the kinds of residuals are not known beforehand. The variances of corners, robot and
board are estimated from the squared residuals of each kind, divided by its redundancy (variance
components, Foerstner 1979).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.cameras.arm import Arm
from pytest_twin.calibration.cameras.increments import (
    apply_change,
    by_measured,
    difference,
    jacobian_by_first,
    jacobian_by_second,
    jacobian_of_inverse,
)
from pytest_twin.calibration.cameras.reprojection import Corners, reprojection_residuals
from pytest_twin.calibration.closed_form import inverse
from pytest_twin.calibration.solvers.algebraic import Mount

_HUBER = 2.5
"""Residuals beyond this many standard deviations enter the cost linearly. Huber's 1.345 is for 10 %
outliers; corners and robots have fewer."""


@dataclass(frozen=True)
class Noise:
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


LEAST_NOISE = Noise(0.01, 5e-6, 5e-6, 1e-5)
"""Lower bounds of the estimated noise, which exact synthetic data need."""


@dataclass(frozen=True)
class Unknowns:
    """Values of the unknowns.

    Attributes:
        hand_eye, robot_world: (4, 4), see ``HandEye``, m.
        intrinsics: (16,) in the order of ``NAMES``.
        camera_from_target: (n, 4, 4), m.
        board: (corners, 3) positions of the corners in the target's frame, m.
        arm: (k,) steps of joint zeros and link deviations from the arm's state, rad and m.
    """

    hand_eye: FloatArray
    robot_world: FloatArray
    intrinsics: FloatArray
    camera_from_target: FloatArray
    board: FloatArray
    arm: FloatArray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Model:
    """Measurements and free parameters of a bundle adjustment.

    The globals are the unknowns that all images share. Their order is: free intrinsics, hand-eye
    and robot-world (with a robot), the arm's own parameters, the board's coordinates (if the board
    is free).

    Attributes:
        base_from_flange: (n, 4, 4) m, or None.
        corners: corners of all images.
        mount: where the camera is mounted.
        free: indices of the free intrinsics.
        drawing: (corners, 3) corners of the board's drawing, m; None if the board is exact.
        arm: robot arm whose joint zeros or links are free; None if ``base_from_flange`` is given.
    """

    base_from_flange: FloatArray | None
    corners: Corners
    mount: Mount
    free: np.ndarray
    drawing: FloatArray | None
    arm: Arm | None = None

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
    def board(self) -> np.ndarray:
        """Indices of the board's coordinates among the globals."""
        before = len(self.free) + len(self.transforms) + len(self.own)
        return before + np.arange(0 if self.drawing is None else self.drawing.size)

    @property
    def count(self) -> int:
        """Number of globals."""
        return len(self.free) + len(self.transforms) + len(self.own) + len(self.board)

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
    """Normal equations at given unknowns, with the target poses eliminated (Schur complement).

    Attributes:
        cost: robust sum of squares.
        pixels, robot, deviation: residuals of corners (m, 2), px, of robot poses (k, 6), m and rad,
            and of the board (corners, 3), m.
        pixel_weights, robot_weights: (m,) and (k,) weights of Huber's function.
        pixel_slopes: (m, 2, 6) Jacobian by the target's pose and (m, 2, count) by the globals,
            divided by the noise.
        robot_slopes: the same of the robot residuals, (k, 6, 6) and (k, 6, count).
        schur, right: (count, count) matrix and (count,) right side for the globals.
        coupling, pose_block, pose_right: (n, count, 6), (n, 6, 6) and (n, 6) blocks of the target
            poses, from which their step follows.
    """

    cost: float
    pixels: FloatArray
    robot: FloatArray
    deviation: FloatArray
    pixel_weights: FloatArray
    robot_weights: FloatArray
    pixel_slopes: tuple[FloatArray, FloatArray]
    robot_slopes: tuple[FloatArray, FloatArray]
    schur: FloatArray
    right: FloatArray
    coupling: FloatArray
    pose_block: FloatArray
    pose_right: FloatArray

    def step(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """(count,) step of the globals and (n, 6) steps of the target's poses.

        Only the globals are damped, because the corners of an image determine the pose of its
        target.
        """
        schur = self.schur + damping * np.diag(np.diag(self.schur))
        move = -np.linalg.solve(schur, self.right)
        inner = self.pose_right + np.einsum("ngi,g->ni", self.coupling, move)
        poses = -np.linalg.solve(self.pose_block, inner[..., None])[..., 0]
        return np.asarray(move, dtype=np.float64), np.asarray(poses, dtype=np.float64)


def linearize(model: Model, unknowns: Unknowns, noise: Noise) -> Equations:
    """Return the weighted normal equations at given values of the unknowns."""
    corners = replace(model.corners, points=unknowns.board[model.corners.ids])
    pixels, by_pose, by_intrinsics = reprojection_residuals(
        unknowns.intrinsics, unknowns.camera_from_target, corners
    )
    robot, by_transforms, robot_by_pose = model.robot(unknowns)
    by_globals = np.zeros((len(pixels), 2, model.count))
    by_globals[:, :, model.intrinsics] = by_intrinsics[:, :, model.free]
    deviation = np.zeros_like(unknowns.board)
    if model.drawing is not None:
        deviation = unknowns.board - model.drawing
        turns = unknowns.camera_from_target[corners.image][:, :3, :3]
        columns = model.board.reshape(-1, 3)[corners.ids]
        rows = np.arange(len(pixels))
        by_globals[rows[:, None], :, columns] = np.swapaxes(by_pose[:, :, :3] @ turns, 1, 2)
    robot_by_globals = np.zeros((len(robot), 6, model.count))
    robot_by_globals[:, :, np.r_[model.transforms, model.own]] = by_transforms
    prior = np.zeros(0) if model.arm is None else model.arm.precision
    values = np.zeros(0) if model.arm is None else model.arm.values(unknowns.arm)

    # The two coordinates of a corner, or the six of a pose, get one common weight.
    scale = np.repeat([1.0 / noise.position, 1.0 / noise.orientation], 3)
    pixel_cost, pixel_weight = _huber(np.mean((pixels / noise.pixel) ** 2, axis=1))
    robot_cost, robot_weight = _huber(np.mean((robot * scale) ** 2, axis=1))
    cost = 2.0 * pixel_cost.sum() + 6.0 * robot_cost.sum()
    cost += np.sum((deviation / noise.board) ** 2) + np.sum(prior * values**2)

    white = (np.sqrt(pixel_weight) / noise.pixel)[:, None, None]
    robot_white = np.sqrt(robot_weight)[:, None, None] * scale[None, :, None]
    ap, ag, ep = white * by_pose, white * by_globals, white[..., 0] * pixels
    rp, rg = robot_white * robot_by_pose, robot_white * robot_by_globals
    er = robot_white[..., 0] * robot

    starts = model.corners.starts
    back = np.swapaxes(ap, 1, 2)
    block = np.add.reduceat(back @ ap, starts)
    pose_right = np.add.reduceat((back @ ep[..., None])[..., 0], starts)
    coupling = np.add.reduceat(np.swapaxes(ag, 1, 2) @ ap, starts)
    full = _normal_matrix(ag) + _normal_matrix(rg)
    right = np.einsum("mcg,mc->g", ag, ep) + np.einsum("mcg,mc->g", rg, er)
    if len(robot):
        block += np.swapaxes(rp, 1, 2) @ rp
        pose_right += (np.swapaxes(rp, 1, 2) @ er[..., None])[..., 0]
        coupling += np.swapaxes(rg, 1, 2) @ rp
    full[model.own, model.own] += prior
    right[model.own] += prior * values
    if model.drawing is not None:
        full[model.board, model.board] += 1.0 / noise.board**2
        right[model.board] += deviation.ravel() / noise.board**2

    solved = np.linalg.solve(block, np.swapaxes(coupling, 1, 2))
    schur = full - np.tensordot(coupling, solved, ([0, 2], [0, 1]))
    right = right - np.tensordot(solved, pose_right, ([0, 1], [0, 1]))
    return Equations(
        float(cost), pixels, robot, deviation, pixel_weight, robot_weight, (ap, ag), (rp, rg),
        schur, right, coupling, block, pose_right,
    )  # fmt: skip


def apply_step(model: Model, at: Unknowns, move: FloatArray, poses: FloatArray) -> Unknowns:
    """Return the unknowns after a step of the globals and of the target's poses."""
    intrinsics = at.intrinsics.copy()
    intrinsics[model.free] += move[model.intrinsics]
    found = replace(
        at, intrinsics=intrinsics, camera_from_target=apply_change(at.camera_from_target, poses)
    )
    if len(model.transforms):
        turns = move[model.transforms]
        found = replace(
            found,
            hand_eye=apply_change(at.hand_eye, turns[:6]),
            robot_world=apply_change(at.robot_world, turns[6:]),
        )
    if len(model.own):
        found = replace(found, arm=at.arm + move[model.own])
    if len(model.board):
        found = replace(found, board=at.board + move[model.board].reshape(-1, 3))
    return found


def noise_of(model: Model, unknowns: Unknowns, noise: Noise) -> Noise:
    """Estimate the noise of each kind of residual from its squares and its redundancy."""
    equations = linearize(model, unknowns, noise)
    covariance = np.linalg.inv(equations.schur)
    inner = np.linalg.inv(equations.pose_block)
    # Covariance between the globals and each pose, and of each pose.
    gain = equations.coupling @ inner
    cross = -covariance @ gain
    poses = inner - np.swapaxes(gain, 1, 2) @ cross

    def used(by_pose: FloatArray, by_globals: FloatArray, image: np.ndarray) -> FloatArray:
        """(rows, coordinates) leverage of each whitened residual."""
        return np.asarray(
            np.einsum("mci,mci->mc", by_pose @ poses[image], by_pose)
            + np.einsum("mcg,mcg->mc", by_globals @ covariance, by_globals)
            + 2.0 * np.einsum("mci,mci->mc", by_globals @ cross[image], by_pose)
        )

    def size(squares: float, count: float, taken: float, least: float) -> float:
        return max(float(np.sqrt(squares / max(count - taken, 0.02 * count))), least)

    taken = float(used(*equations.pixel_slopes, model.corners.image).sum())
    weights = equations.pixel_weights
    squares = float(np.sum(weights[:, None] * equations.pixels**2))
    found = replace(noise, pixel=size(squares, 2 * weights.sum(), taken, LEAST_NOISE.pixel))
    if model.base_from_flange is not None:
        each = used(*equations.robot_slopes, np.arange(model.corners.images)).sum(axis=0)
        weights = equations.robot_weights
        sums = np.sum(weights[:, None] * equations.robot**2, axis=0)
        count = 3.0 * float(weights.sum())
        found = replace(
            found,
            position=size(sums[:3].sum(), count, each[:3].sum(), LEAST_NOISE.position),
            orientation=size(sums[3:].sum(), count, each[3:].sum(), LEAST_NOISE.orientation),
        )
    if model.drawing is not None:
        known = np.diag(covariance)[model.board].sum() / noise.board**2
        squares = float(np.sum(equations.deviation**2))
        count = float(len(model.board))
        found = replace(found, board=size(squares, count, float(known), LEAST_NOISE.board))
    return found


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
