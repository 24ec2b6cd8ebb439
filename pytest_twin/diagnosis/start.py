"""Where a window starts is known as well as its samples say: the rest is taken out of residuals.

Under an effort command an error of the initial velocity grows with time, far above the sensors'
noise; a velocity servo keeps an error of the initial position for ever. Their windows therefore
have the initial state free, held by a Gaussian prior of what a local cubic leaves open: residuals
are freed of what a shifted start explains (partialled-out nuisance parameters; Golub, Pereyra, SIAM
J. Numer. Anal. 10, 1973). Where the motor of a velocity servo stands behind a gear that gives is
no reading, and it keeps an error of that, too: it is free within what its load stretches the gear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Scales, effect_values
from pytest_twin.effects.base import FloatArray
from pytest_twin.effects.rows import RowSimulator, Segment

_STEP = 1e-4


@dataclass(frozen=True, slots=True)
class FreeStart:
    """The start of one window.

    Attributes:
        response: (samples * joints, shifts) positions per unit of what is free, as
            :func:`free_shifts` counts.
        solve: (shifts, samples * joints) the start's most probable shift under a residual.
    """

    response: FloatArray
    solve: FloatArray

    def freed(self, residual: FloatArray) -> FloatArray:
        """(samples, joints) residual without what a shifted start explains."""
        flat = residual.ravel()
        left: FloatArray = (flat - self.response @ (self.solve @ flat)).reshape(residual.shape)
        return left

    def freed_columns(self, residuals: FloatArray) -> FloatArray:
        """The same of (samples, joints, k) residuals."""
        flat = residuals.reshape(-1, residuals.shape[2])
        left: FloatArray = flat - self.response @ (self.solve @ flat)
        return left.reshape(residuals.shape)


def free_shifts(segment: Segment) -> int:
    """How much of (positions, velocities) is free when a segment starts.

    Of a velocity servo the positions alone: it takes an error of the velocity for a moment only,
    which leaves one of the position.
    """
    joints = len(segment.initial_position)
    if segment.amid:
        return 2 * joints
    return joints if segment.mode == "velocity" else 0


def free_starts(
    segments: Sequence[Segment],
    joints: Sequence[str],
    noise: FloatArray,
    width: float,
    threads: int,
    hypothesis: Hypothesis = EMPTY,
    scales: Scales | None = None,
) -> dict[int, FreeStart]:
    """A free start for every segment that would keep an error of it.

    Args:
        segments: all of the problem.
        joints: their columns.
        noise: (joints,) deviation of a sample, rad or m.
        width: s, of the local cubic that gave the initial states.
        threads: of the batch.
        hypothesis, scales: around which the shifted starts are simulated: under friction a shift
            of the velocity dies out, without it it grows with time.
    """
    count = len(joints)
    shifts = [free_shifts(s) for s in segments]
    scales = scales or Scales({})
    stretch = _stretch(segments, joints, threads, hypothesis, scales)
    motors = [[int(k) for k in np.flatnonzero(s)] for s in stretch]
    shifted: list[Segment] = []
    for s, free, behind in zip(segments, shifts, motors, strict=True):
        if free:
            shifted.append(s)
        for k in range(free):
            q, v = s.initial_position.copy(), s.initial_velocity.copy()
            (q if k < count else v)[k % count] += _STEP
            shifted.append(replace(s, initial_position=q, initial_velocity=v))
        for k in behind:
            shift = np.zeros(count)
            shift[k] = _STEP
            shifted.append(replace(s, motor_shift=shift))
    if not shifted:
        return {}
    rows = np.arange(len(shifted))
    values = effect_values([hypothesis] * len(rows), count, scales)
    found = RowSimulator(shifted, joints, threads=threads).simulate(rows, values)
    out: dict[int, FreeStart] = {}
    at = 0
    for i, free in enumerate(shifts):
        if not free:
            continue
        ways = free + len(motors[i])
        base, *moved = found[at : at + ways + 1]
        at += ways + 1
        response = np.stack([(m.position - base.position).ravel() / _STEP for m in moved], axis=1)
        if not np.isfinite(response).all():
            continue
        out[i] = free_start(response, segments[i], noise, width, stretch[i][motors[i]])
    return out


def _stretch(
    segments: Sequence[Segment],
    joints: Sequence[str],
    threads: int,
    hypothesis: Hypothesis,
    scales: Scales,
) -> FloatArray:
    """(segments, joints) deviation of where motors start: by as much as usual efforts stretch their
    gears, where these give and the servo is of velocity.
    """
    out = np.zeros((len(segments), len(joints)))
    rows = np.flatnonzero([s.mode == "velocity" for s in segments])
    if len(rows) and any(t.law.overrides("separates") for t in hypothesis.terms):
        values = effect_values([hypothesis] * len(rows), len(joints), scales)
        simulator = RowSimulator(segments, joints, threads=threads)
        out[rows] = simulator.gear_stretch(rows, values, scales.of["effort"])
    return out


def free_start(
    response: FloatArray,
    segment: Segment,
    noise: FloatArray,
    width: float,
    stretch: FloatArray | None = None,
) -> FreeStart:
    """A free start from its (samples * joints, shifts) response.

    Args:
        response: to shifts of the links, then of motors behind gears that give.
        segment, noise, width: as above.
        stretch: (motors,) deviation of where those stand, rad or m.
    """
    weight = np.tile(1.0 / noise**2, len(response) // len(noise))
    behind = np.zeros(0) if stretch is None else stretch
    links = response.shape[1] - len(behind)
    prior = 1.0 / np.concatenate([_start_variance(segment, noise, width)[:links], behind**2])
    normal = response.T @ (weight[:, None] * response) + np.diag(prior)
    # Where a motion runs away shifts of its start all look alike: least squares share them out.
    solve = np.linalg.lstsq(normal, response.T * weight, rcond=None)[0].astype(np.float64)
    return FreeStart(response, solve)


def _start_variance(segment: Segment, noise: FloatArray, width: float) -> FloatArray:
    """(2 joints,) variance of initial position and velocity from a local cubic over ``width`` s."""
    interval = float(np.median(np.diff(segment.time)))
    t = np.arange(-width / 2, width / 2 + interval / 2, interval) / (width / 2)
    basis = np.vander(t, 4, increasing=True)
    covariance = np.linalg.inv(basis.T @ basis)
    spread = np.array([covariance[0, 0], covariance[1, 1] / (width / 2) ** 2])
    variance: FloatArray = np.outer(spread, noise**2 * _bent(segment, noise, width)).ravel()
    # A cubic bends less than a motion that reverses: leave the start more room than noise alone.
    return 4.0 * variance


def _bent(segment: Segment, noise: FloatArray, width: float) -> FloatArray:
    """(joints,) by how many times the noise's variance samples after a start are off cubics."""
    if segment.history is None:
        return np.ones(len(noise))
    time, smooth, _ = segment.history
    near = segment.time <= segment.start + width
    line = np.stack([np.interp(segment.time[near], time, s) for s in smooth.T], axis=1)
    off = np.mean((segment.position[near] - line) ** 2, axis=0)
    square: FloatArray = np.maximum(off / noise**2, 1.0)
    return square
