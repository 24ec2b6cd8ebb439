"""Normal equations of a camera, its images, its board and a robot, and the noise of each.

How much each kind of residual weighs is not known beforehand. The noise of corners, robot and
board is estimated from the residuals of each kind over its redundancy (Foerstner 1979, variance
components).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.cameras.arm import Arm
from pytest_twin.calibration.cameras.increments import (
    by_first,
    by_inverse,
    by_measured,
    by_second,
    changed,
    difference,
    inverse,
)
from pytest_twin.calibration.cameras.reprojection import Corners, reprojection_residuals
from pytest_twin.calibration.solvers.algebraic import Mount

_HUBER = 2.5
"""Residuals beyond this many standard deviations count linearly. Huber's 1.345 is for a tenth of
outliers; corners and robots have fewer."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations. The defaults are those of a usual camera, robot and printed board.

    Attributes:
        pixel: of a corner's coordinate, px.
        position: of each coordinate of the flange's position, m.
        orientation: of each coordinate of the flange's rotation vector, rad.
        board: of each coordinate of a corner's place on the board, m.
    """

    pixel: float = 0.3
    position: float = 5e-4
    orientation: float = 1e-3
    board: float = 1e-4

    @property
    def vector(self) -> FloatArray:
        """(4,) the values in this order."""
        return np.array([self.pixel, self.position, self.orientation, self.board])


LEAST_NOISE = Noise(0.01, 5e-6, 5e-6, 1e-5)
"""Below this nothing is measured; data without noise need a limit."""


@dataclass(frozen=True)
class Unknowns:
    """Values of what is estimated.

    Attributes:
        hand_eye, robot_world: (4, 4), see ``HandEye``, m.
        intrinsics: (16,) in the order of ``NAMES``.
        camera_from_target: (n, 4, 4), m.
        board: (corners, 3) places of the target's corners, m.
        arm: (k,) steps of joint zeros and links from where the arm has them, rad and m.
    """

    hand_eye: FloatArray
    robot_world: FloatArray
    intrinsics: FloatArray
    camera_from_target: FloatArray
    board: FloatArray
    arm: FloatArray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Model:
    """What was measured, and what is free.

    The globals, which all images share, are in this order: free intrinsics, hand-eye and
    robot-world where there is a robot, the arm's own parameters, the board's coordinates where
    it is free.

    Attributes:
        base_from_flange: (n, 4, 4) m, or None.
        corners: of all images.
        mount: what the flange carries.
        free: indices of the free intrinsics.
        drawing: (corners, 3) the board as it was drawn, m; None where it is exact.
        arm: the robot whose zeros or links are free; None where ``base_from_flange`` is given.
    """

    base_from_flange: FloatArray | None
    corners: Corners
    mount: Mount
    free: np.ndarray
    drawing: FloatArray | None
    arm: Arm | None = None

    @property
    def intrinsics(self) -> np.ndarray:
        """Places of the free intrinsics among the globals."""
        return np.arange(len(self.free))

    @property
    def transforms(self) -> np.ndarray:
        """Places of hand-eye and robot-world among the globals."""
        return len(self.free) + np.arange(0 if self.base_from_flange is None else 12)

    @property
    def own(self) -> np.ndarray:
        """Places of the arm's own parameters among the globals."""
        before = len(self.free) + len(self.transforms)
        return before + np.arange(0 if self.arm is None else self.arm.count)

    @property
    def board(self) -> np.ndarray:
        """Places of the board's coordinates among the globals."""
        before = len(self.free) + len(self.transforms) + len(self.own)
        return before + np.arange(0 if self.drawing is None else self.drawing.size)

    @property
    def count(self) -> int:
        """How many globals there are."""
        return len(self.free) + len(self.transforms) + len(self.own) + len(self.board)

    def robot(self, unknowns: Unknowns) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(k, 6) residuals of the robot's poses; slopes by transforms and arm, by target poses."""
        if self.base_from_flange is None:
            return np.zeros((0, 6)), np.zeros((0, 6, 0)), np.zeros((0, 6, 6))
        seen, by_pose = unknowns.camera_from_target, np.eye(6)
        if self.mount == "hand":
            seen, by_pose = inverse(seen), by_inverse(seen)
        world = unknowns.robot_world
        at, back = world @ seen, inverse(unknowns.hand_eye)
        reported, by_own = self.base_from_flange, np.zeros((len(at), 6, 0))
        if self.arm is not None:
            reported, by_own = self.arm.flange(unknowns.arm)
        predicted = at @ back
        residual, slope = difference(reported, predicted)
        by_own = by_measured(reported, predicted, slope) @ by_own
        through = slope @ by_first(at, np.broadcast_to(back, at.shape))
        by_world = through @ by_first(np.broadcast_to(world, seen.shape), seen)
        by_hand_eye = slope @ by_second(at) @ by_inverse(unknowns.hand_eye)
        by_transforms = np.concatenate([by_hand_eye, by_world, by_own], axis=2)
        return residual, by_transforms, through @ by_second(world) @ by_pose


@dataclass(frozen=True)
class Equations:
    """Normal equations at one place, the poses of the target eliminated (Schur complement).

    Attributes:
        cost: robust sum of squares.
        pixels: (m, 2) px; ``robot``: (k, 6) m, rad; ``deviation``: (corners, 3) m.
        pixel_weights, robot_weights: (m,), (k,) of Huber's function.
        pixel_slopes: (m, 2, 6) by the target's pose and (m, 2, count) by the globals, whitened.
        robot_slopes: (k, 6, 6) and (k, 6, count), whitened.
        schur, right: (count, count), (count,) for the globals.
        coupling: (n, count, 6); ``pose_block``: (n, 6, 6); ``pose_right``: (n, 6).
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
        """(count,) change of the globals and (n, 6) of the target's poses.

        Damping is on the globals: a pose of the target is determined by its own corners.
        """
        schur = self.schur + damping * np.diag(np.diag(self.schur))
        move = -np.linalg.solve(schur, self.right)
        inner = self.pose_right + np.einsum("ngi,g->ni", self.coupling, move)
        poses = -np.linalg.solve(self.pose_block, inner[..., None])[..., 0]
        return np.asarray(move, dtype=np.float64), np.asarray(poses, dtype=np.float64)


def linearized(model: Model, unknowns: Unknowns, noise: Noise) -> Equations:
    """The weighted normal equations at some values of the unknowns."""
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

    # Two coordinates of a corner, or six of a pose, are an outlier together.
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
    full = _squared(ag) + _squared(rg)
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


def moved(model: Model, at: Unknowns, move: FloatArray, poses: FloatArray) -> Unknowns:
    """The unknowns after a step of the globals and of the target's poses."""
    intrinsics = at.intrinsics.copy()
    intrinsics[model.free] += move[model.intrinsics]
    found = replace(
        at, intrinsics=intrinsics, camera_from_target=changed(at.camera_from_target, poses)
    )
    if len(model.transforms):
        turns = move[model.transforms]
        found = replace(
            found,
            hand_eye=changed(at.hand_eye, turns[:6]),
            robot_world=changed(at.robot_world, turns[6:]),
        )
    if len(model.own):
        found = replace(found, arm=at.arm + move[model.own])
    if len(model.board):
        found = replace(found, board=at.board + move[model.board].reshape(-1, 3))
    return found


def noise_of(model: Model, unknowns: Unknowns, noise: Noise) -> Noise:
    """The noise that the residuals show: their squares over their redundancy, each kind apart."""
    equations = linearized(model, unknowns, noise)
    covariance = np.linalg.inv(equations.schur)
    inner = np.linalg.inv(equations.pose_block)
    # Covariance of the globals with each pose, and of each pose.
    gain = equations.coupling @ inner
    cross = -covariance @ gain
    poses = inner - np.swapaxes(gain, 1, 2) @ cross

    def used(by_pose: FloatArray, by_globals: FloatArray, image: np.ndarray) -> FloatArray:
        """(rows, coordinates) share of each whitened residual that the unknowns take up."""
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


def _squared(slopes: FloatArray) -> FloatArray:
    rows = slopes.reshape(-1, slopes.shape[2])
    return np.asarray(rows.T @ rows, dtype=np.float64)


def _huber(squares: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Costs and weights of squared residuals in standard deviations."""
    size = np.asarray(np.sqrt(squares), dtype=np.float64)
    far = size > _HUBER
    cost = np.where(far, 2.0 * _HUBER * size - _HUBER**2, squares)
    weight = np.where(far, _HUBER / np.maximum(size, _HUBER), 1.0)
    return np.asarray(cost, dtype=np.float64), np.asarray(weight, dtype=np.float64)
