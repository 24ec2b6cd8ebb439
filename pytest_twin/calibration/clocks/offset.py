"""Estimate time offset, drift and hand-eye of two pose streams in one least-squares problem."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.cameras.increments import (
    apply_change,
    difference,
    jacobian_by_first,
    jacobian_by_second,
)
from pytest_twin.calibration.clocks.streams import PoseStream
from pytest_twin.calibration.solvers.algebraic import HandEye
from pytest_twin.calibration.transform_derivatives import skew
from pytest_twin.metrics.pose import inverse
from pytest_twin.time_limit import is_over

_STEPS = 40
"""Largest number of Gauss-Newton steps."""
SLOPE_S = 0.05
"""Half of the time span over which the hand's velocity at a stamp is measured. With a span of 0.02
s, position noise of 0.4 mm would look like a speed of 28 mm/s, and a hand at rest would seem to
determine the offset."""
_AROUND_S = (0.1, -0.1, 0.2, -0.2)
"""Times from a stamp to the poses that give the hand's acceleration."""
_CUT = 3.0
"""Number of standard deviations beyond which a pose gets less weight (Huber's function)."""
BLOCKS = 20
"""Number of time segments for the covariance. Errors of neighbouring poses are correlated; those of
segments of a second or more are nearly independent."""

COUNT, SCALE, SMOOTHING = 16, 14, 15
"""Number of unknowns, and indices of the scale of the camera's positions and of the variance of an
average over time, s^2, by which the camera's poses are smoother than the hand's."""

SMOOTHED_FROM_S = 0.02
"""Standard deviation of an average over time from which it is a mistake. Motion during an exposure
of 33 ms is averaged by 10 ms, interpolation at 25 Hz averages by 16 ms. Those of 15 ms moved frames
by at most 0.8 half widths of their intervals."""
_SURE_SMOOTHING = 5.0
"""Smallest variance of an average in standard deviations. With 19 degrees of freedom, chance gives
one in ten thousand."""

MOST_OFFSET_SPREAD_S = 0.05
"""Half width of the offset's 95 % interval above which the motion does not determine it. It
corresponds to 25 mm at a speed of 0.5 m/s."""


@dataclass(frozen=True)
class ClockFit:
    """Estimated offset, drift, hand-eye and robot-world transforms.

    Attributes:
        offset: time of the hand's clock minus the same time of the camera's clock, s, in the
            middle of the recording.
        drift: rate of the offset, s/s.
        solved: transforms of ``hand @ hand_eye = robot_world @ seen``.
        covariance: (16, 16) of offset, drift, hand-eye and robot-world (each x, y, z, rotation
            vector in the parent's axes), scale and smoothing; zero for what is fixed.
        quantile: (16,) half widths of 95 % intervals in standard deviations.
        translation, rotation: (n,) errors of the fitted poses, m and rad.
        scale: stated size of the target divided by its real one.
    """

    offset: float
    drift: float
    solved: HandEye
    covariance: FloatArray
    quantile: FloatArray
    translation: FloatArray
    rotation: FloatArray
    scale: float = 1.0

    @classmethod
    def without_spread(
        cls, offset: float, solved: HandEye, drift: float = 0.0, scale: float = 1.0
    ) -> ClockFit:
        """Return values without a covariance, such as initial ones."""
        nothing = np.zeros(0)
        covariance, quantile = np.zeros((COUNT, COUNT)), np.full(COUNT, 1.96)
        return cls(offset, drift, solved, covariance, quantile, nothing, nothing, scale)

    def interval(self, at: int) -> float:
        """Half width of the 95 % interval of the offset (0) or the drift (1)."""
        return float(self.quantile[at] * np.sqrt(self.covariance[at, at]))

    def target_in_hand(self, seen: FloatArray) -> FloatArray:
        """(n, 4, 4) ``hand_eye @ inverse(seen)`` with the positions of ``seen`` in true metres."""
        metric = seen.copy()
        metric[:, :3, 3] /= self.scale
        return np.asarray(self.solved.hand_eye @ inverse(metric))


def hand_times(camera: PoseStream, offset: float, drift: float, middle: float) -> FloatArray:
    """Times of the hand's clock at the camera's stamps, s."""
    return camera.time + offset + drift * (camera.time - middle)


def spread_rows(
    hand: PoseStream, camera: PoseStream, fit: ClockFit, middle: float, most: int
) -> tuple[np.ndarray, FloatArray]:
    """Rows of the camera's stream, evenly over the hand's time range, and their hand times, s.

    Args:
        middle: time of the camera's clock at which the offset holds, s.
        most: largest number of rows.
    """
    time = hand_times(camera, fit.offset, fit.drift, middle)
    inside = np.flatnonzero((time >= hand.time[0]) & (time <= hand.time[-1]))
    rows = inside[np.linspace(0, len(inside) - 1, min(most, len(inside))).astype(int)]
    return rows, time[rows]


def errors_at(
    hand: PoseStream, camera: PoseStream, seen: FloatArray, fit: ClockFit, middle: float
) -> tuple[FloatArray, FloatArray]:
    """(n,) translation (m) and rotation (rad) errors of camera poses in the hand's time range.

    Args:
        seen: (n, 4, 4) poses of the camera stream as ``robot_world`` carries them.
        middle: time of the camera's clock at which the offset holds, s.
    """
    time = hand_times(camera, fit.offset, fit.drift, middle)
    inside = (time >= hand.time[0]) & (time <= hand.time[-1])
    poses = hand.at(time[inside]) @ fit.target_in_hand(seen[inside])
    world = np.broadcast_to(fit.solved.robot_world, poses.shape)
    residual, _ = difference(world, poses)
    return np.linalg.norm(residual[:, :3], axis=1), np.linalg.norm(residual[:, 3:], axis=1)


def fit_clocks(
    hand: PoseStream,
    camera: PoseStream,
    seen: FloatArray,
    start: ClockFit,
    middle: float,
    *,
    with_drift: bool,
    size_tolerance: float = 0.0,
) -> ClockFit:
    """Fit all poses of the camera to the hand's interpolated poses by least squares.

    Args:
        seen: (n, 4, 4) poses of the camera stream as ``robot_world`` carries them.
        start: initial offset, transforms and scale.
        middle: time of the camera's clock at which the offset holds, s.
        with_drift: whether the drift is estimated; otherwise it is 0.
        size_tolerance: standard deviation of the target's size, relative to the stated one; above 0
            the size is estimated.

    Raises:
        numpy.linalg.LinAlgError: the motion does not determine the unknowns.
    """
    free = np.r_[0, [1] * with_drift, 2:14, [SCALE] * (size_tolerance > 0.0)].astype(int)
    weight = np.zeros(COUNT)
    if size_tolerance > 0.0:
        weight[SCALE] = size_tolerance**-2
    equations = _Equations(hand, camera, seen, middle, free, weight[free])
    at = equations.minimized(start)
    if size_tolerance > 0.0:
        # Least squares counts neighbouring poses as independent, so the data would outweigh the
        # stated size. The prior's weight grows as the variance of the data's part does.
        spread = equations.spread(at)
        row = spread.bread[-1]
        independent, blocked = (float(row @ one @ row) for one in (spread.information, spread.meat))
        grown = max(blocked / independent, 1.0) if independent > 0.0 else 1.0
        equations = replace(equations, prior_weight=grown * equations.prior_weight)
        at = equations.minimized(at)
    spread = equations.spread(at)
    of_data = spread.bread @ spread.meat @ spread.bread
    of_prior = spread.bread @ np.diag(equations.prior_weight * size_tolerance) ** 2 @ spread.bread
    covariance = np.zeros((COUNT, COUNT))
    covariance[np.ix_(free, free)] = of_data + of_prior
    # The variance of the prior is known, so its degrees of freedom are infinite (Satterthwaite).
    known = 1.0 + np.diag(of_prior) / np.maximum(np.diag(of_data), 1e-300)
    degrees = np.full(COUNT, BLOCKS - 1.0)
    degrees[free] *= spread.evenness * known**2
    return replace(
        at,
        covariance=covariance,
        quantile=np.asarray(student.ppf(0.975, np.maximum(degrees, 1.0))),
        translation=np.linalg.norm(spread.residual[:, :3], axis=1),
        rotation=np.linalg.norm(spread.residual[:, 3:], axis=1),
    )


def smoothing(
    hand: PoseStream, camera: PoseStream, seen: FloatArray, at: ClockFit, middle: float
) -> float:
    """Return the time over which the camera's poses are averaged more than the hand's, s.

    It is the standard deviation of the weights of the average, negative if the hand's poses are
    smoother, and 0 if there is none within chance. An average changes a pose by half of the
    variance of its weights times the acceleration; its mean delay is a part of the offset.

    Args:
        seen: (n, 4, 4) poses of the camera stream as ``robot_world`` carries them.
        middle: time of the camera's clock at which the offset holds, s.
    """
    time = hand_times(camera, at.offset, at.drift, middle)
    inside = (time - _AROUND_S[2] >= hand.time[0]) & (time + _AROUND_S[2] <= hand.time[-1])
    free = np.r_[0, 2:COUNT]
    equations = _Equations(
        hand, camera.rows(inside), seen[inside], middle, free, np.zeros(len(free))
    )
    try:
        step, spread = equations.step(at), equations.spread(at)
    except np.linalg.LinAlgError:
        return 0.0
    variance = float(step[SMOOTHING])
    std = float(np.sqrt((spread.bread @ spread.meat @ spread.bread)[-1, -1]))
    size = float(np.sqrt(abs(variance)))
    if size < SMOOTHED_FROM_S or not abs(variance) > _SURE_SMOOTHING * std:
        return 0.0
    return float(np.copysign(size, variance))


@dataclass(frozen=True)
class _Spread:
    """Parts of the covariance of the free unknowns.

    Attributes:
        bread: inverse of the information of data and prior.
        information: information of the data if all poses are independent.
        meat: covariance of the data's gradient, from its sums over time segments.
        evenness: (free,) how evenly the segments determine each unknown, 1 / BLOCKS to 1.
        residual: (n, 6) residuals, m and rad.
    """

    bread: FloatArray
    information: FloatArray
    meat: FloatArray
    evenness: FloatArray
    residual: FloatArray


@dataclass(frozen=True)
class _Equations:
    """Least-squares equations of two streams.

    Attributes:
        seen: (n, 4, 4) poses of the camera stream as ``robot_world`` carries them.
        middle: time of the camera's clock at which the offset holds, s.
        free: indices of the free unknowns.
        prior_weight: (free,) inverse variance of each unknown's prior, 0 without one. Only the
            scale has a prior; its mean is 1.
    """

    hand: PoseStream
    camera: PoseStream
    seen: FloatArray
    middle: float
    free: np.ndarray
    prior_weight: FloatArray

    def minimized(self, at: ClockFit) -> ClockFit:
        """Return the fit after Gauss-Newton steps of the free unknowns."""
        for _ in range(_STEPS):
            move = self.step(at)
            at = _apply_step(at, move)
            # Steps below a microsecond, a micrometre and a microradian are negligible.
            if np.abs(move).max() < 1e-7 or is_over():
                break
        return at

    def step(self, at: ClockFit) -> FloatArray:
        """Return the (16,) Gauss-Newton step of the free unknowns; 0 for the others."""
        prior = np.sqrt(self.prior_weight)
        rows, residual = self._whitened(*self._linearized(at))
        flat = np.concatenate([rows.reshape(-1, len(self.free)), np.diag(prior)])
        right = np.concatenate([residual.ravel(), prior * (at.scale - 1.0)])
        norm = np.linalg.norm(flat, axis=0)
        move = np.zeros(COUNT)
        move[self.free] = np.linalg.lstsq(flat / norm, -right, rcond=1e-10)[0] / norm
        return move

    def spread(self, at: ClockFit) -> _Spread:
        """Return the parts of the covariance at a fit."""
        residual, slopes = self._linearized(at)
        rows, whitened = self._whitened(residual, slopes)
        gradient = np.einsum("nci,nc->ni", rows, whitened)
        flat = rows.reshape(-1, len(self.free))
        information = flat.T @ flat
        bread = np.asarray(
            np.linalg.inv(information + np.diag(self.prior_weight)), dtype=np.float64
        )
        # Errors of neighbouring poses are correlated, so the gradient is summed over time segments.
        # The sum over all of them balances the prior and is no noise.
        blocks = np.array_split(np.arange(len(gradient)), BLOCKS)
        sums = np.array([gradient[block].sum(axis=0) for block in blocks])
        sums -= sums.mean(axis=0)
        # Segments in which the hand hardly moves carry little information. The degrees of freedom
        # of each variance follow from Satterthwaite: 19 if all segments carry the same information,
        # 1 if one segment carries all.
        by_row = np.einsum("ij,ncj->nci", bread, rows) ** 2
        parts = np.array([by_row[block].sum(axis=(0, 1)) for block in blocks])
        return _Spread(
            bread,
            information,
            sums.T @ sums * BLOCKS / (BLOCKS - 1),
            parts.sum(axis=0) ** 2 / (BLOCKS * np.sum(parts**2, axis=0)),
            residual,
        )

    def _whitened(self, residual: FloatArray, slopes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 6, free) derivatives and (n, 6) residuals, divided by their robust noise."""
        sizes, weight = _weights(residual)
        scale = np.sqrt(weight)[:, None] / np.repeat(sizes, 3)
        return (scale[:, :, None] * slopes)[:, :, self.free], scale * residual

    def _linearized(self, at: ClockFit) -> tuple[FloatArray, FloatArray]:
        """(n, 6) residuals and (n, 6, 16) Jacobian of the poses in the hand's time range."""
        hand, camera = self.hand, self.camera
        time = hand_times(camera, at.offset, at.drift, self.middle)
        inside = (time - SLOPE_S >= hand.time[0]) & (time + SLOPE_S <= hand.time[-1])
        if inside.sum() < 2 * BLOCKS:
            raise np.linalg.LinAlgError("the streams do not overlap")
        time, mine = time[inside], self.seen[inside]
        flange = hand.at(time)
        around, _ = difference(hand.at(time - SLOPE_S), hand.at(time + SLOPE_S))
        turn = hand.at(time - SLOPE_S)[:, :3, :3]
        speed = _turned(turn, around) / (2.0 * SLOPE_S)
        # Without the pose at the stamp, whose noise is in the residual too.
        ends = (difference(flange, hand.at(time + step))[0] for step in _AROUND_S)
        ahead, behind, far_ahead, far_behind = ends
        acceleration = _turned(flange[:, :3, :3], far_ahead + far_behind - ahead - behind) / (
            3.0 * _AROUND_S[0] ** 2
        )
        eye, world = at.solved.hand_eye, at.solved.robot_world
        carried = flange @ eye
        metric = mine.copy()
        metric[:, :3, 3] /= at.scale
        back = inverse(metric)
        # The residual compares robot_world from the hand's pose with the estimate, at the target.
        predicted = carried @ back
        residual, slope = difference(np.broadcast_to(world, predicted.shape), predicted)
        by_carried = slope @ jacobian_by_first(carried, back)
        by_flange = by_carried @ jacobian_by_first(flange, np.broadcast_to(eye, flange.shape))
        by_time, by_bend = (
            np.einsum("nij,nj->ni", by_flange, motion) for motion in (speed, acceleration)
        )
        by_eye = by_carried @ jacobian_by_second(flange)
        # A change of ``world`` equals the opposite change of ``predicted``, about the base's
        # origin.
        to_world = -slope
        cross_with_arm = skew(predicted[:, :3, 3] - world[:3, 3])
        to_world[:, :3, 3:] += world[:3, :3].T @ cross_with_arm
        drifted = by_time * (camera.time[inside] - self.middle)[:, None]
        # Positions of the residual are compared in the units of the camera: measured minus scale
        # times predicted. Measured divided by scale would shrink with the noise of the camera.
        lever = np.einsum("nij,nj->ni", carried[:, :3, :3], at.scale * back[:, :3, 3])
        by_scale = -np.einsum("nij,nj->ni", slope[:, :, :3], lever) / at.scale
        by_scale[:, :3] += residual[:, :3]
        slopes = np.concatenate(
            [
                by_time[..., None],
                drifted[..., None],
                by_eye,
                to_world,
                by_scale[..., None],
                by_bend[..., None] / 2.0,
            ],
            axis=2,
        )
        residual[:, :3] *= at.scale
        slopes[:, :3, np.arange(COUNT) != SCALE] *= at.scale
        return residual, slopes


def _turned(turn: FloatArray, motion: FloatArray) -> FloatArray:
    """(n, 6) positions and rotation vectors in the parent's axes, from those in a frame's own."""
    parts = [np.einsum("nij,nj->ni", turn, part) for part in (motion[:, :3], motion[:, 3:])]
    return np.concatenate(parts, axis=1)


def _weights(residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Robust standard deviations of translation (m) and rotation (rad), and each pose's weight."""
    squares = np.stack([residual[:, :3], residual[:, 3:]], axis=1) ** 2
    # The median of a chi-squared variable with three degrees of freedom is 2.366.
    sizes = np.sqrt(np.median(squares.sum(axis=2), axis=0) / 2.366)
    sizes = np.maximum(sizes, 1e-9)
    distance = np.sqrt((squares.sum(axis=2) / sizes**2).sum(axis=1) / 6.0)
    return sizes, np.where(distance > _CUT, _CUT / np.maximum(distance, _CUT), 1.0)


def _apply_step(at: ClockFit, move: FloatArray) -> ClockFit:
    solved = HandEye(
        apply_change(at.solved.hand_eye, move[2:8]), apply_change(at.solved.robot_world, move[8:14])
    )
    return replace(
        at,
        offset=at.offset + float(move[0]),
        drift=at.drift + float(move[1]),
        solved=solved,
        scale=at.scale + float(move[SCALE]),
    )
