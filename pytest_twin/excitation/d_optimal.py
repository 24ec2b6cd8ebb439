"""Optimize Fourier coefficients for information about the base parameters (D-optimal design)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.optimize

from pytest_twin.arrays import FloatArray
from pytest_twin.excitation.approved_limits import ApprovedLimits
from pytest_twin.excitation.closed_loop import WORSE
from pytest_twin.excitation.fourier import REST, Series, free_time, series
from pytest_twin.excitation.motion import JointStates, Path
from pytest_twin.identification.regressor.base_parameters import BaseParameters
from pytest_twin.identification.regressor.regressor import Regressor
from pytest_twin.time_limit import is_over

STARTS = 3
"""Number of random starts of the optimization."""
_ITERATIONS = 40
"""Largest number of iterations from each start, without distances."""
_NEAR_ITERATIONS = 15
"""Largest number of further iterations with distances, which are expensive."""
_NEAR_SAMPLES = 2
"""Step between poses that are checked for nearness: every second one."""
_TOLERANCE = 1e-5
"""Relative change of log det at which a start ends: 0.005 for a log det of 500."""
_SAMPLES_PER_PERIOD = 8
"""Samples per period of the highest harmonic, in the sum of information during optimization."""
_SHARPNESS = 40.0
"""Exponent of the p-norm, a smooth approximation of a signal's maximum, 1 to 15 % too high."""
_RIDGE = 1e-9
"""Value added to the normalized diagonal of the information matrix, so that its determinant is
positive."""
_EFFORT_WEIGHT = 200.0
"""Weight of efforts above their limit in the objective, against the logarithm of the
determinant."""
_SPARE_WEIGHT = 20.0
"""Weight of poses with small distances in the objective."""
_SPARE = 0.02
"""Spare distance below which a pose is penalized, m."""
_DIFFERENCE = 1e-5
"""Step of finite differences, rad or m, and relative to the largest velocity or acceleration."""
_OFF_CENTRE = 0.3
"""Distance of the start from the middle of the range, as a share of half the range, above which
the series swings about the middle. Below it, the move to the middle is not worth its time."""
_POSE_DIFFERENCE = 1e-4
"""Step of difference quotients, rad or m: distances are accurate to 1e-8 m."""


@dataclass(frozen=True, slots=True)
class Optimum:
    """Optimal coefficients and their information.

    Attributes:
        coefficients: (j, m) of :class:`Series`, rad/s or m/s, within all limits.
        log_det: natural logarithm of the determinant of one period's information matrix.
        starts: log det of the result of each start.
    """

    coefficients: FloatArray
    log_det: float
    starts: tuple[float, ...]


class Design:
    """Information about base parameters as a function of free coefficients.

    The free vector has, for each joint, its m coefficients, of which only the direction matters,
    and the logit of its amplitude as a share of the largest permitted one. Every vector therefore
    satisfies the limits, without constraints.

    Args:
        approved: limits with their margins.
        regressor: regressor of the approved joints.
        std: (joints,) standard deviation of the effort's noise, N*m or N.
        spare: function of a pose (j,) and an upper bound: spare distance, m.
    """

    def __init__(
        self,
        approved: ApprovedLimits,
        regressor: Regressor,
        base: BaseParameters,
        std: FloatArray,
        spare: Callable[[FloatArray, float], float] = lambda position, most: most,
    ) -> None:
        self._spare = spare
        self._approved = approved
        self._regressor = regressor
        self._base = base
        self._std = std
        self.centre, self.travel = self._centre_and_travel()
        whole = series(approved, self.travel)
        highest = float(whole.frequencies.max() * whole.period)
        samples = min(len(whole.time), max(40, round(_SAMPLES_PER_PERIOD * highest)))
        self.series: Series = series(approved, self.travel, samples)
        self._fine = whole
        lower, upper = approved.room
        self._up, self._down = upper - self.centre, self.centre - lower
        self._effort = np.minimum(approved.effort, approved.array("effort") / WORSE)

    def optimum(self, seed: int, starts: int = STARTS) -> Optimum:
        """Return the best result of several starts, using exact derivatives of the information."""
        random = np.random.default_rng(seed)
        found: list[tuple[float, FloatArray]] = []
        for _ in range(starts):
            if found and is_over():
                break
            first = random.standard_normal((len(self._up), self.series.width + 1))
            first[:, -1] = 2.0
            free = self._minimized(first, _ITERATIONS, near=False)
            found.append((self.log_det(self.coefficients(free)), free))
        best = max(found, key=lambda one: one[0])[1]
        # Distances are expensive to compute, so only the best start includes them.
        if self._nearness(self._states(self.coefficients(best))[0])[0] > 0.0:
            best = self._minimized(best, _NEAR_ITERATIONS, near=True)
        coefficients = self.coefficients(best)
        return Optimum(coefficients, self.log_det(coefficients), tuple(v for v, _ in found))

    def _minimized(self, first: FloatArray, iterations: int, near: bool) -> FloatArray:
        solved = scipy.optimize.minimize(
            partial(self._objective, near=near), first.ravel(),
            jac=True, method="L-BFGS-B", options={"maxiter": iterations, "ftol": _TOLERANCE},
            callback=_end_at_limit,
        )  # fmt: skip
        return np.asarray(solved.x).reshape(first.shape)

    def random(self, seed: int) -> FloatArray:
        """Return (j, m) coefficients of a random motion that uses the limits fully."""
        random = np.random.default_rng(seed)
        free = random.standard_normal((len(self._up), self.series.width + 1))
        free[:, -1] = np.inf
        return self.coefficients(free)

    def coefficients(self, free: FloatArray) -> FloatArray:
        """Return (j, m) coefficients within all limits from the free vector (j, m + 1)."""
        z = free[:, :-1]
        most = _most_used(self._fine, z, self._up, self._down, self._approved)
        share = 1.0 / (1.0 + np.exp(-free[:, -1]))
        return np.asarray(z * (share / most)[:, None])

    def log_det(self, coefficients: FloatArray) -> float:
        """Return log det of the information of one period; -inf if a parameter is undetermined."""
        sign, value = np.linalg.slogdet(
            self._information(self._matrix(*self._states(coefficients)))
        )
        return float(value) if sign > 0 else -np.inf

    def drawn(self, coefficients: FloatArray, scale: float = 1.0) -> JointStates:
        """Return the whole motion: to the centre, as many periods as fit, and back.

        Args:
            coefficients: (j, m), rad/s or m/s.
            scale: share of the amplitude and of the distance to the centre.
        """
        approved, own = self._approved, self._fine
        centre = approved.start + scale * (self.centre - approved.start)
        path = Path(approved.start, approved.speed, approved.acceleration, approved.rate)
        path.dwell(REST)
        path.move(centre)
        around = scale * coefficients.T
        once = (centre + own.basis @ around, own.velocity @ around, own.acceleration @ around)
        free = free_time(approved, self.travel)
        path.repeat(*once, times=max(1, int(free / own.period + 1e-9)))
        path.move(approved.start)
        path.dwell(REST - 1.0 / approved.rate)
        return path.states()

    # -- inside

    def _centre_and_travel(self) -> tuple[FloatArray, float]:
        """Return the centre pose of the series, and the time to it and back, s.

        The centre is the start, or the middle of the range if that is far away and reachable.
        """
        approved = self._approved
        start = approved.start
        lower, upper = approved.room
        middle = 0.5 * (lower + upper)
        off = float((np.abs(middle - start) / (0.5 * (upper - lower))).max())
        path = Path(start, approved.speed, approved.acceleration, approved.rate)
        travel = 2.0 * path.time_to(middle)
        low, high = approved.band
        free = free_time(approved, travel)
        enough = np.floor(high * free) - np.ceil(low * free) >= 1.0
        way = (start + share * (middle - start) for share in np.linspace(1.0, 0.0, 6))
        if off > _OFF_CENTRE and enough and all(self._spare(at, _SPARE) > 0.0 for at in way):
            return middle, travel
        return start, 0.0

    def _states(self, coefficients: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        own = self.series
        return (
            self.centre + own.basis @ coefficients.T,
            own.velocity @ coefficients.T,
            own.acceleration @ coefficients.T,
        )

    def _matrix(self, q: FloatArray, v: FloatArray, a: FloatArray) -> FloatArray:
        return self._regressor.matrix(q, v, a)

    def _information(self, matrix: FloatArray) -> FloatArray:
        weighted = self._base.matrix(matrix) / self._std[:, None]
        stacked = weighted.reshape(-1, weighted.shape[-1])
        return np.asarray(stacked.T @ stacked)

    def _objective(self, flat: FloatArray, near: bool) -> tuple[float, FloatArray]:
        """Return minus log det plus penalties on effort and nearness, and its gradient."""
        free = flat.reshape(len(self._up), -1)
        z, logit = free[:, :-1], free[:, -1]
        used, used_by_z = _smooth_used(self.series, z, self._up, self._down, self._approved)
        share = 1.0 / (1.0 + np.exp(-logit))
        coefficients = z * (share / used)[:, None]
        states = self._states(coefficients)
        value, by_states = self._value(states)
        if near:
            nearness, by_position = self._nearness(states[0])
            value, by_states[0] = value + nearness, by_states[0] + by_position
        own = self.series
        by_coefficients = (
            by_states[0].T @ own.basis
            + by_states[1].T @ own.velocity
            + by_states[2].T @ own.acceleration
        )
        along = np.einsum("jm,jm->j", by_coefficients, z)
        gradient = np.empty_like(free)
        gradient[:, :-1] = (share / used)[:, None] * by_coefficients - (share / used**2 * along)[
            :, None
        ] * used_by_z
        gradient[:, -1] = share * (1.0 - share) / used * along
        return value, gradient.ravel()

    def _value(
        self, states: tuple[FloatArray, FloatArray, FloatArray]
    ) -> tuple[float, list[FloatArray]]:
        """Return the objective and its (n, j) derivatives by position, velocity, acceleration."""
        matrix = self._matrix(*states)
        information = self._information(matrix)
        sizes = np.sqrt(np.maximum(np.diag(information), 1e-300))
        scaled = information / np.outer(sizes, sizes) + _RIDGE * np.eye(len(sizes))
        value = -float(np.linalg.slogdet(scaled)[1] + 2.0 * np.log(sizes).sum())
        inverse = np.linalg.inv(scaled) / np.outer(sizes, sizes)
        columns = self._base.independent
        # d log det / d matrix, by (sample, joint, parameter).
        pull = -2.0 * (matrix[..., columns] / self._std[:, None] ** 2) @ inverse
        effort = matrix @ self._regressor.prior
        over = np.maximum(np.abs(effort) / self._effort - 1.0, 0.0)
        value += _EFFORT_WEIGHT * float((over**2).mean(axis=0).sum())
        push = 2.0 * _EFFORT_WEIGHT / len(effort) * over * np.sign(effort) / self._effort
        found = []
        for which in range(3):
            by = np.empty_like(states[which])
            step = _DIFFERENCE * (
                1.0 if which == 0 else max(1.0, float(np.abs(states[which]).max()))
            )
            for joint in range(by.shape[1]):
                moved = list(states)
                moved[which] = states[which].copy()
                moved[which][:, joint] += step
                change = (self._matrix(*moved) - matrix) / step
                by[:, joint] = np.einsum("njb,njb->n", pull, change[..., columns])
                by[:, joint] += np.einsum("nj,njp,p->n", push, change, self._regressor.prior)
            found.append(by)
        return value, found

    def _nearness(self, position: FloatArray) -> tuple[float, FloatArray]:
        """Return the penalty on poses with small distances, and its derivative (n, j)."""
        spares = np.full(len(position), _SPARE)
        spares[::_NEAR_SAMPLES] = [self._spare(pose, _SPARE) for pose in position[::_NEAR_SAMPLES]]
        short = 1.0 - spares / _SPARE
        by = np.zeros_like(position)
        for at in np.flatnonzero(short > 0.0):
            for joint in range(position.shape[1]):
                moved = position[at].copy()
                moved[joint] += _POSE_DIFFERENCE
                change = (self._spare(moved, _SPARE) - spares[at]) / _POSE_DIFFERENCE
                by[at, joint] = -2.0 * _SPARE_WEIGHT * short[at] / _SPARE * change
        return float(_SPARE_WEIGHT * (short**2).sum()), by


def _end_at_limit(intermediate_result: scipy.optimize.OptimizeResult) -> None:
    """End a minimization with its last result when the run must end."""
    del intermediate_result
    if is_over():
        raise StopIteration


def _limit_shares(
    own: Series, z: FloatArray, up: FloatArray, down: FloatArray, approved: ApprovedLimits
) -> FloatArray:
    """Return (4, n, j) shares of limits: position above and below, speed, acceleration."""
    away = own.basis @ z.T
    return np.stack(
        [
            np.maximum(away / np.maximum(up, 1e-9), 0.0),
            np.maximum(-away / np.maximum(down, 1e-9), 0.0),
            np.abs(own.velocity @ z.T) / approved.speed,
            np.abs(own.acceleration @ z.T) / approved.acceleration,
        ]
    )


def _most_used(
    own: Series, z: FloatArray, up: FloatArray, down: FloatArray, approved: ApprovedLimits
) -> FloatArray:
    """Return the (j,) largest share of a limit."""
    return np.asarray(_limit_shares(own, z, up, down, approved).max(axis=(0, 1)))


def _smooth_used(
    own: Series, z: FloatArray, up: FloatArray, down: FloatArray, approved: ApprovedLimits
) -> tuple[FloatArray, FloatArray]:
    """Return a (j,) smooth upper bound of the largest share, and its derivative (j, m) by z."""
    shares = _limit_shares(own, z, up, down, approved)
    most = shares.max(axis=(0, 1))
    powers = (shares / most) ** _SHARPNESS
    total = powers.sum(axis=(0, 1))
    used = most * total ** (1.0 / _SHARPNESS)
    # d used / d share = (share / used)^(p - 1)
    by_share = (shares / used) ** (_SHARPNESS - 1.0)
    away, speed, acceleration = (part @ z.T for part in (own.basis, own.velocity, own.acceleration))
    by_z = (
        (by_share[0] / np.maximum(up, 1e-9) - by_share[1] / np.maximum(down, 1e-9)).T @ own.basis
        + (by_share[2] * np.sign(speed) / approved.speed).T @ own.velocity
        + (by_share[3] * np.sign(acceleration) / approved.acceleration).T @ own.acceleration
    )
    del away
    return used, np.asarray(by_z)
