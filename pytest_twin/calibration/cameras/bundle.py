"""Hand-eye calibration by least squares on reprojection, with a robot that is not exact.

Unknown are the two transforms around the robot, some intrinsics, and the pose of the target in each
image. A corner's residual is its reprojection error. A robot pose's residual is the difference
between the flange pose that the robot reports and the one that the unknowns give. Without the
second kind an error of the robot would go into the intrinsics, with a robot held exact too.

How much each kind weighs is not known beforehand: pixel noise, and the robot's error in position
and in orientation, are estimated from the residuals and their redundancy (Foerstner 1979; variance
components).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.boards.detection import Detection
from pytest_twin.calibration.cameras.increments import (
    by_first,
    by_inverse,
    by_second,
    changed,
    difference,
    inverse,
)
from pytest_twin.calibration.cameras.intrinsics import NAMES
from pytest_twin.calibration.cameras.reprojection import (
    Corners,
    corners_of,
    reprojection_residuals,
)
from pytest_twin.calibration.solvers.algebraic import HandEye, Mount

_STEPS, _ROUNDS = 60, 25
_SETTLED = 1e-8
_ROUND_SETTLED = 0.01
_HUBER = 2.5
"""Residuals beyond this many standard deviations count linearly (Huber's 1.345 is for a tenth of
outliers; corners and robots have fewer)."""
_LEAST_PX, _LEAST_M, _LEAST_RAD = 0.01, 5e-6, 5e-6
"""Noise below which nothing is measured: what synthetic data without noise need."""
_FIRST_PX, _FIRST_M, _FIRST_RAD = 0.3, 5e-4, 1e-3
"""Noise of a usual camera and a usual robot: where the estimation of the noise starts."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations.

    Attributes:
        pixel: of a corner's coordinate, px.
        position: of each coordinate of the flange's position, m.
        orientation: of each coordinate of the flange's rotation vector, rad.
    """

    pixel: float = _FIRST_PX
    position: float = _FIRST_M
    orientation: float = _FIRST_RAD


@dataclass(frozen=True)
class Unknowns:
    """Values of what is estimated.

    Attributes:
        hand_eye, robot_world: (4, 4), see ``HandEye``, m.
        intrinsics: (16,) in the order of ``NAMES``.
        camera_from_target: (n, 4, 4), m.
    """

    hand_eye: FloatArray
    robot_world: FloatArray
    intrinsics: FloatArray
    camera_from_target: FloatArray


@dataclass(frozen=True)
class Bundle:
    """What was found.

    Attributes:
        solved: the two transforms.
        intrinsics: (16,) in the order of ``NAMES``.
        free: names of the intrinsics that were estimated.
        camera_from_target: (n, 4, 4) pose of the target in each image, m.
        covariance: (12 + free, 12 + free): hand-eye, robot-world (each x, y, z, then the rotation
            vector, in the axes of the parent), then the free intrinsics.
        noise: of corners and robot.
        residuals: (m, 2) px.
        robot: (n, 6) how far the robot's pose is off, in the flange's axes: m, then rad.
        weights: (n,) weight of each robot pose, 1 for one that fits.
    """

    solved: HandEye
    intrinsics: FloatArray
    free: tuple[str, ...]
    camera_from_target: FloatArray
    covariance: FloatArray
    noise: Noise
    residuals: FloatArray
    robot: FloatArray
    weights: FloatArray

    @property
    def reprojection_rms(self) -> float:
        """Reprojection error, px, root mean square over coordinates."""
        return float(np.sqrt(np.mean(self.residuals**2)))


def bundle(
    base_from_flange: FloatArray,
    detections: Sequence[Detection],
    start: Unknowns,
    mount: Mount,
    free: Sequence[str] = (),
    noise: Noise | None = None,
) -> Bundle:
    """The least-squares estimate from images and the robot's poses.

    Args:
        base_from_flange: (n, 4, 4) as the robot reports them, m.
        detections: (n) usable detections.
        start: where the search starts.
        mount: what the flange carries.
        free: intrinsics that are estimated.
        noise: where the standard deviations are known; estimated where it is left out.

    Raises:
        numpy.linalg.LinAlgError: the poses do not determine the unknowns.
    """
    model = _Model(
        base_from_flange,
        corners_of(detections),
        mount,
        np.array([NAMES.index(name) for name in free], dtype=int),
    )
    unknowns, sizes = start, noise or Noise()
    for _ in range(_ROUNDS):
        unknowns = _minimized(model, unknowns, sizes)
        if noise is not None:
            break
        new = _noise_of(model, unknowns, sizes)
        change = max(
            abs(np.log(new.pixel / sizes.pixel)),
            abs(np.log(new.position / sizes.position)),
            abs(np.log(new.orientation / sizes.orientation)),
        )
        sizes = new
        if change < _ROUND_SETTLED:
            break
    system = _linearized(model, unknowns, sizes)
    order = np.r_[len(free) : len(free) + 12, : len(free)]
    covariance = np.linalg.inv(system.schur)[np.ix_(order, order)]
    return Bundle(
        HandEye(unknowns.hand_eye, unknowns.robot_world),
        unknowns.intrinsics,
        tuple(free),
        unknowns.camera_from_target,
        covariance,
        sizes,
        system.pixels,
        system.robot,
        system.robot_weights,
    )


@dataclass(frozen=True)
class _Model:
    base_from_flange: FloatArray
    corners: Corners
    mount: Mount
    free: np.ndarray

    def robot(self, unknowns: Unknowns) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """(n, 6) residuals of the robot's poses; slopes by hand-eye, robot-world, target pose."""
        poses, world = unknowns.camera_from_target, unknowns.robot_world
        seen, by_pose = poses, np.eye(6)
        if self.mount == "hand":
            seen, by_pose = inverse(poses), by_inverse(poses)
        at = world @ seen
        back = inverse(unknowns.hand_eye)
        predicted = at @ back
        residual, slope = difference(self.base_from_flange, predicted)
        through = slope @ by_first(at, np.broadcast_to(back, at.shape))
        by_world = through @ by_first(np.broadcast_to(world, seen.shape), seen)
        by_hand_eye = slope @ by_second(at) @ by_inverse(unknowns.hand_eye)
        return residual, by_hand_eye, by_world, through @ by_second(world) @ by_pose


@dataclass(frozen=True)
class _System:
    """Normal equations at one place, the target poses eliminated."""

    cost: float
    pixels: FloatArray
    robot: FloatArray
    pixel_weights: FloatArray
    robot_weights: FloatArray
    pixel_by_pose: FloatArray
    pixel_by_intrinsics: FloatArray
    robot_by_pose: FloatArray
    robot_by_global: FloatArray
    schur: FloatArray
    right: FloatArray
    coupling: FloatArray
    pose_block: FloatArray
    pose_right: FloatArray

    def step(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """(globals,) and (n, 6) changes.

        Damping is on the unknowns that remain: the poses of targets are always determined by
        their own corners.
        """
        schur = self.schur + damping * np.diag(np.diag(self.schur))
        move = -np.linalg.solve(schur, self.right)
        inner = self.pose_right + np.einsum("gni,g->ni", self.coupling, move)
        return move, -np.linalg.solve(self.pose_block, inner[..., None])[..., 0]


def _huber(squares: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Costs and weights of squared residuals in standard deviations."""
    size = np.asarray(np.sqrt(squares), dtype=np.float64)
    far = size > _HUBER
    safe = np.maximum(size, _HUBER)
    cost = np.where(far, 2.0 * _HUBER * size - _HUBER**2, squares)
    weight = np.where(far, _HUBER / safe, 1.0)
    return np.asarray(cost, dtype=np.float64), np.asarray(weight, dtype=np.float64)


def _linearized(model: _Model, unknowns: Unknowns, noise: Noise) -> _System:
    """The weighted normal equations: globals are free intrinsics, hand-eye, robot-world."""
    pixels, by_pose, by_intrinsics = reprojection_residuals(
        unknowns.intrinsics, unknowns.camera_from_target, model.corners
    )
    robot, by_hand_eye, by_world, robot_by_pose = model.robot(unknowns)
    scale = np.repeat([1.0 / noise.position, 1.0 / noise.orientation], 3)
    robot_by_global = np.concatenate(
        [np.zeros((len(robot), 6, len(model.free))), by_hand_eye, by_world], axis=2
    )
    # Two coordinates of a corner, or six of a pose, are an outlier together.
    pixel_cost, pixel_weight = _huber(np.mean((pixels / noise.pixel) ** 2, axis=1))
    robot_cost, robot_weight = _huber(np.mean((robot * scale) ** 2, axis=1))
    cost = float(2.0 * pixel_cost.sum() + 6.0 * robot_cost.sum())

    wp = (np.sqrt(pixel_weight) / noise.pixel)[:, None, None]
    wr = np.sqrt(robot_weight)[:, None, None] * scale[None, :, None]
    ap, ai = wp * by_pose, wp * by_intrinsics[:, :, model.free]
    rp, rg = wr * robot_by_pose, wr * robot_by_global
    ep, er = wp[..., 0] * pixels, wr[..., 0] * robot
    starts, free = model.corners.starts, len(model.free)

    block = np.add.reduceat(np.einsum("mci,mcj->mij", ap, ap), starts)
    block += np.einsum("nci,ncj->nij", rp, rp)
    pose_right = np.add.reduceat(np.einsum("mci,mc->mi", ap, ep), starts)
    pose_right += np.einsum("nci,nc->ni", rp, er)
    coupling = np.einsum("ncg,nci->gni", rg, rp)
    coupling[:free] += np.add.reduceat(np.einsum("mcg,mci->gmi", ai, ap), starts, axis=1)
    full = np.einsum("ncg,nch->gh", rg, rg)
    full[:free, :free] += np.einsum("mcg,mch->gh", ai, ai)
    right = np.einsum("ncg,nc->g", rg, er)
    right[:free] += np.einsum("mcg,mc->g", ai, ep)

    solved = np.linalg.solve(block, np.moveaxis(coupling, 0, 2))
    schur = full - np.einsum("gni,nih->gh", coupling, solved)
    right = right - np.einsum("nih,ni->h", solved, pose_right)
    return _System(
        cost, pixels, robot, pixel_weight, robot_weight, ap, ai, rp, rg, schur, right, coupling,
        block, pose_right,
    )  # fmt: skip


def _minimized(model: _Model, unknowns: Unknowns, noise: Noise) -> Unknowns:
    """The unknowns of least cost near where they are (Levenberg-Marquardt)."""
    system = _linearized(model, unknowns, noise)
    damping = 1e-6
    for _ in range(_STEPS):
        move, poses = system.step(damping)
        tried = _moved(model, unknowns, move, poses)
        new = _linearized(model, tried, noise)
        if not np.isfinite(new.cost) or new.cost > system.cost:
            damping *= 10.0
            if damping > 1e8:
                break
            continue
        settled = system.cost - new.cost <= _SETTLED * system.cost
        unknowns, system = tried, new
        damping = max(damping / 10.0, 1e-9)
        if settled:
            break
    return unknowns


def _moved(model: _Model, at: Unknowns, move: FloatArray, poses: FloatArray) -> Unknowns:
    free = len(model.free)
    intrinsics = at.intrinsics.copy()
    intrinsics[model.free] += move[:free]
    return Unknowns(
        changed(at.hand_eye, move[free : free + 6]),
        changed(at.robot_world, move[free + 6 :]),
        intrinsics,
        changed(at.camera_from_target, poses),
    )


def _noise_of(model: _Model, unknowns: Unknowns, noise: Noise) -> Noise:
    """The noise that the residuals show: their squares over their redundancy, each kind apart."""
    system = _linearized(model, unknowns, noise)
    covariance = np.linalg.inv(system.schur)
    inner = np.linalg.inv(system.pose_block)
    # Covariance of each pose, and of it with the globals.
    gain = np.einsum("gni,nij->gnj", system.coupling, inner)
    cross = -np.einsum("gh,hnj->gnj", covariance, gain)
    poses = inner - np.einsum("gni,gnj->nij", gain, cross)
    free = len(model.free)
    image = model.corners.image

    ap, ai = system.pixel_by_pose, system.pixel_by_intrinsics
    used = np.einsum("mci,mij,mcj->", ap, poses[image], ap)
    used += np.einsum("mcg,gh,mch->", ai, covariance[:free, :free], ai)
    used += 2.0 * np.einsum("mcg,gmi,mci->", ai, cross[:free][:, image], ap)
    rp, rg = system.robot_by_pose, system.robot_by_global
    each = np.einsum("nci,nij,ncj->c", rp, poses, rp)
    each += np.einsum("ncg,gh,nch->c", rg, covariance, rg)
    each += 2.0 * np.einsum("ncg,gni,nci->c", rg, cross, rp)

    def size(squares: float, count: float, taken: float, least: float) -> float:
        return max(float(np.sqrt(squares / max(count - taken, 0.1 * count))), least)

    pw, rw = system.pixel_weights, system.robot_weights
    squares = np.sum(rw[:, None] * system.robot**2, axis=0)
    return Noise(
        size(float(np.sum(pw[:, None] * system.pixels**2)), 2 * pw.sum(), used, _LEAST_PX),
        size(squares[:3].sum(), 3 * rw.sum(), each[:3].sum(), _LEAST_M),
        size(squares[3:].sum(), 3 * rw.sum(), each[3:].sum(), _LEAST_RAD),
    )
