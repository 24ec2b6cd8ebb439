"""Windows with a free initial state: its error is removed from residuals.

Under an effort command an error of the initial velocity grows with time, far above the sensors'
noise. A velocity servo keeps an error of the initial position for ever. The initial state of their
windows is therefore a nuisance parameter that is partialled out (Golub, Pereyra, SIAM J. Numer.
Anal. 10, 1973), with a Gaussian prior from a local cubic fit of the samples. The position of a
motor behind an elastic transmission is not measured: it is free within the deflection by its load.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Scales, effect_values
from pytest_twin.diagnosis.windows import start_width
from pytest_twin.effects import catalogue
from pytest_twin.effects.active_effects import EffectValues
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment

_STEP = 1e-4
# Deviations away where motors are tried to start, and at most; the share of a segment's misfit that
# is clearly less; how often they are then moved, by this share of a deviation at least, and no
# further where that leaves this share of the misfit.
_TRIED, _FAR, _CLEARLY = (-2.0, -1.0, 1.0, 2.0), 3.0, 0.95
_PLACINGS, _SETTLED, _NO_WORSE = 6, 0.005, 1.01


@dataclass(frozen=True, slots=True)
class FreeInitialState:
    """The start of one window.

    Attributes:
        response: (samples * joints, shifts) positions per unit of what is free, as
            :func:`free_shifts` counts, then of motors behind gears that give.
        solve: (shifts, samples * joints) the start's most probable shift under a residual.
        motors: (joints,) deviation of where those start, rad or m; 0 where they are their links.
    """

    response: FloatArray
    solve: FloatArray
    motors: FloatArray

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

    def motor_shift(self, residual: FloatArray) -> FloatArray:
        """(joints,) by how much motors most probably start elsewhere, under (samples, joints)."""
        shift = np.zeros(len(self.motors))
        behind = self.motors > 0.0
        if behind.any():
            shift[behind] = (self.solve @ residual.ravel())[-int(behind.sum()) :]
        return shift


@dataclass(frozen=True, slots=True)
class FreeInitialStates:
    """Where segments start, by their numbers.

    Attributes:
        free: of those that would keep an error of it.
        motor_shifts: (joints,) rad or m, as :class:`Segment` has them.
        stepped: steps that were simulated to find them.
    """

    free: dict[int, FreeInitialState]
    motor_shifts: dict[int, FloatArray]
    stepped: int = 0


def free_shifts(segment: Segment) -> int:
    """How much of (positions, velocities) is free when a segment starts.

    Of a velocity servo the positions alone: it takes an error of the velocity for a moment only,
    which leaves one of the position.
    """
    joints = len(segment.initial_position)
    if segment.amid:
        return 2 * joints
    return joints if segment.mode == "velocity" else 0


def free_initial_states(
    segments: Sequence[Segment],
    joints: Sequence[str],
    noise: FloatArray,
    threads: int,
    hypothesis: Hypothesis = EMPTY,
    scales: Scales | None = None,
    fixed: EffectValues | None = None,
) -> FreeInitialStates:
    """A free start for every segment that would keep an error of it.

    A gear stretches by more than small shifts tell, and within its play a shift says nothing:
    motors are tried on either side, then moved to where they seem to start (Gauss, Newton) as long
    as that leaves no more.

    Args:
        segments: all of the problem.
        joints: their columns.
        noise: (joints,) deviation of a sample, rad or m.
        threads: of the batch.
        hypothesis, scales: around which the shifted starts are simulated: under friction a shift
            of the velocity dies out, without it it grows with time.
        fixed: effects under every hypothesis, (1, joints).
    """
    if not any(map(free_shifts, segments)):
        return FreeInitialStates({}, {})
    scales = scales or Scales({})
    simulator = BatchSimulator(segments, joints, threads=threads, fixed=fixed)
    stretch = _stretch(simulator, hypothesis, scales)
    placing = _Placing(simulator, noise, hypothesis, scales, stretch)
    for far in _TRIED if placing.shifts else ():
        placing.improved({i: far * stretch[i] for i in placing.shifts}, _CLEARLY)
    apart = list(placing.shifts)
    for _ in range(_PLACINGS):
        steps = {i: placing.found[i].motor_step for i in apart}
        apart = [i for i, step in steps.items() if (np.abs(step) > _SETTLED * stretch[i]).any()]
        if not apart:
            break
        most = {i: _FAR * stretch[i] for i in apart}
        tried = {i: np.clip(placing.shifts[i] + steps[i], -most[i], most[i]) for i in apart}
        apart = placing.improved(tried, _NO_WORSE)
    free = {i: around.start for i, around in placing.found.items()}
    return FreeInitialStates(free, placing.shifts, placing.stepped)


@dataclass(frozen=True, slots=True)
class _Around:
    """A segment's start, what was measured beside what is predicted there, (samples, joints), and
    the squared sum of what a shifted start leaves of that, in deviations of a sample.
    """

    start: FreeInitialState
    off: FloatArray
    left: float

    @property
    def motor_step(self) -> FloatArray:
        """(joints,) by how much motors seem to start elsewhere."""
        return self.start.motor_shift(self.off)


class _Placing:
    """Free starts of segments, with motors where they were found to leave least.

    Attributes:
        found: segment -> its start.
        shifts: segment -> where its motors start, of those whose gears give.
        stepped: steps that were simulated.
    """

    def __init__(
        self,
        simulator: BatchSimulator,
        noise: FloatArray,
        hypothesis: Hypothesis,
        scales: Scales,
        stretch: FloatArray,
    ) -> None:
        self._simulator, self._noise = simulator, noise
        self._hypothesis, self._scales, self._stretch = hypothesis, scales, stretch
        self.stepped = 0
        none = np.zeros(len(simulator.joints))
        free = [i for i, s in enumerate(simulator.segments) if free_shifts(s)]
        self.found = self._around(dict.fromkeys(free, none))
        self.shifts = {i: none for i in self.found if stretch[i].any()}

    def improved(self, tried: Mapping[int, FloatArray], share: float) -> list[int]:
        """Segments that keep less than a share where their motors are tried: these stay there."""
        there = self._around(tried)
        less = [i for i, around in there.items() if around.left < share * self.found[i].left]
        self.found.update({i: there[i] for i in less})
        self.shifts.update({i: tried[i] for i in less})
        return less

    def _around(self, shifts: Mapping[int, FloatArray]) -> dict[int, _Around]:
        known = self._simulator
        moved = {i: replace(known.segments[i], motor_shift=x) for i, x in shifts.items()}
        shifted = [_shifted(s, self._stretch[i]) for i, s in moved.items()]
        if not shifted:
            return {}
        simulator = BatchSimulator(
            list(chain(*shifted)), known.joints, threads=known.threads, fixed=known.fixed
        )
        rows = np.arange(len(simulator.segments))
        values = effect_values([self._hypothesis] * len(rows), len(known.joints), self._scales)
        found = iter(simulator.simulate(rows, values))
        self.stepped += simulator.stepped
        out = {}
        for (i, s), each in zip(moved.items(), shifted, strict=True):
            base, *others = islice(found, len(each))
            response = [(p.position - base.position).ravel() / _STEP for p in others]
            if np.isfinite(response).all():
                of_shifts = np.stack(response, axis=1)
                start = free_initial_state(of_shifts, s, self._noise, self._stretch[i])
                off = s.position - base.position
                left = float(np.sum((start.freed(off) / self._noise) ** 2))
                out[i] = _Around(start, off, left)
        return out


def _shifted(segment: Segment, stretch: FloatArray) -> list[Segment]:
    """A segment, and with each of its shifts."""
    out, count = [segment], len(stretch)
    for k in range(free_shifts(segment)):
        q, v = segment.initial_position.copy(), segment.initial_velocity.copy()
        (q if k < count else v)[k % count] += _STEP
        out.append(replace(segment, initial_position=q, initial_velocity=v))
    for j in np.flatnonzero(stretch):
        motor = np.zeros(count) if segment.motor_shift is None else segment.motor_shift.copy()
        motor[j] += _STEP
        out.append(replace(segment, motor_shift=motor))
    return out


def _stretch(simulator: BatchSimulator, hypothesis: Hypothesis, scales: Scales) -> FloatArray:
    """(segments, joints) deviation of where motors start: by as much as usual efforts stretch their
    gears, where these give and the servo is of velocity.
    """
    segments, joints = simulator.segments, len(simulator.joints)
    out = np.zeros((len(segments), joints))
    rows = np.flatnonzero([s.mode == "velocity" for s in segments])
    laws = [*(t.law for t in hypothesis.terms), *(catalogue()[e] for e in simulator.fixed)]
    if len(rows) and any(law.is_elastic_transmission for law in laws):
        values = effect_values([hypothesis] * len(rows), joints, scales)
        out[rows] = simulator.gear_stretch(rows, values, scales.of["effort"])
    return out


def free_initial_state(
    response: FloatArray,
    segment: Segment,
    noise: FloatArray,
    motors: FloatArray | None = None,
) -> FreeInitialState:
    """A free start from its (samples * joints, shifts) response.

    Args:
        response: to shifts of the links, then of motors behind gears that give.
        segment: which.
        noise: (joints,) deviation of a sample, rad or m.
        motors: (joints,) deviation of where those start, rad or m; 0 where they are their links.
    """
    weight = np.tile(1.0 / noise**2, len(response) // len(noise))
    motors = np.zeros(len(noise)) if motors is None else motors
    behind = motors[motors > 0.0]
    links = response.shape[1] - len(behind)
    prior = 1.0 / np.concatenate([_start_variance(segment, noise)[:links], behind**2])
    normal = response.T @ (weight[:, None] * response) + np.diag(prior)
    # Where a motion runs away shifts of its start all look alike: least squares share them out.
    solve = np.linalg.lstsq(normal, response.T * weight, rcond=None)[0].astype(np.float64)
    return FreeInitialState(response, solve, motors)


def _start_variance(segment: Segment, noise: FloatArray) -> FloatArray:
    """(2 joints,) variance of initial position and velocity from a local cubic."""
    width = start_width(segment.time)
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
