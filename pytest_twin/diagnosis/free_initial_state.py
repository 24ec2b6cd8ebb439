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
from pytest_twin.diagnosis.window_settings import WINDOWS
from pytest_twin.diagnosis.windows import start_width
from pytest_twin.effects import catalogue
from pytest_twin.effects.active_effects import EffectValues
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Scales, effect_values

# Finite-difference step of initial positions (rad or m) and velocities (rad/s or m/s).
_STEP = 1e-4
# Initial motor positions that are tried, and their limit, in standard deviations of the prior.
_TRIED_SHIFTS, _MAX_SHIFT = (-2.0, -1.0, 1.0, 2.0), 3.0
# Largest number of Gauss-Newton steps, the smallest step in standard deviations, and the share of
# the misfit below which a step is accepted.
_MAX_STEPS, _MIN_STEP, _MISFIT_SHARE = 6, 0.005, 1.01


@dataclass(frozen=True, slots=True)
class FreeInitialState:
    """The free initial state of one window.

    Attributes:
        response: (samples * joints, shifts) Jacobian of positions with respect to the free part of
            the initial state (:func:`count_free_states`), then to motors behind elastic
            transmissions.
        solve: (shifts, samples * joints) maps a residual to the most probable shift (MAP estimate).
        motors: (joints,) standard deviation of initial motor positions, rad or m; 0 with a rigid
            transmission.
    """

    response: FloatArray
    solve: FloatArray
    motors: FloatArray

    def without_initial_error(self, residual: FloatArray) -> FloatArray:
        """(samples, joints) residual minus the part that a shift of the initial state explains."""
        flat = residual.ravel()
        remaining: FloatArray = flat - self.response @ (self.solve @ flat)
        return remaining.reshape(residual.shape)

    def motor_shift(self, residual: FloatArray) -> FloatArray:
        """(joints,) most probable shift of the initial motor positions, rad or m.

        Args:
            residual: (samples, joints) rad or m.
        """
        shift = np.zeros(len(self.motors))
        is_elastic = self.motors > 0.0
        if is_elastic.any():
            shift[is_elastic] = (self.solve @ residual.ravel())[-int(is_elastic.sum()) :]
        return shift


@dataclass(frozen=True, slots=True)
class FreeInitialStates:
    """Free initial states of segments, by index of the segment.

    Attributes:
        free: free initial state of each segment in which its error would not decay.
        motor_shifts: (joints,) shift of initial motor positions, rad or m, as in :class:`Segment`.
        simulated_steps: number of simulated steps that were needed.
    """

    free: dict[int, FreeInitialState]
    motor_shifts: dict[int, FloatArray]
    simulated_steps: int = 0


def count_free_states(segment: Segment) -> int:
    """Number of free elements of a segment's initial (positions, velocities).

    With velocity servos only positions are free: the servo removes an error of the velocity fast,
    and an error of the position remains.
    """
    joints = len(segment.initial_position)
    if segment.starts_in_motion:
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
    """Free initial state of every segment in which an error of it would not decay.

    The deflection of a transmission is too large for a linearization, and within backlash the
    gradient is zero. Several motor positions on both sides are therefore tried first. Gauss-Newton
    steps follow as long as the misfit does not grow.

    Args:
        segments: all segments of the problem.
        joints: names of their columns.
        noise: (joints,) standard deviation of a position sample, rad or m.
        hypothesis, scales: hypothesis for the simulation of shifted initial states, with its
            scales. With friction an error of the velocity decays, without it grows.
        fixed: effects in addition to every hypothesis, values (1, joints).
    """
    if not any(map(count_free_states, segments)):
        return FreeInitialStates({}, {})
    scales = scales or Scales({})
    simulator = BatchSimulator(segments, joints, threads=threads, fixed=fixed)
    motor_deviations = _motor_deviations(simulator, hypothesis, scales)
    search = _InitialStateSearch(simulator, noise, hypothesis, scales, motor_deviations)
    for deviations in _TRIED_SHIFTS if search.shifts else ():
        search.accept_better(
            {i: deviations * motor_deviations[i] for i in search.shifts}, WINDOWS.motor_misfit
        )
    active = list(search.shifts)
    for _ in range(_MAX_STEPS):
        steps = {i: search.found[i].motor_step for i in active}
        active = [
            i for i, step in steps.items() if (np.abs(step) > _MIN_STEP * motor_deviations[i]).any()
        ]
        if not active:
            break
        most = {i: _MAX_SHIFT * motor_deviations[i] for i in active}
        tried = {i: np.clip(search.shifts[i] + steps[i], -most[i], most[i]) for i in active}
        active = search.accept_better(tried, _MISFIT_SHARE)
    free = {i: simulated.start for i, simulated in search.found.items()}
    return FreeInitialStates(free, search.shifts, search.simulated_steps)


@dataclass(frozen=True, slots=True)
class _SimulatedStart:
    """A segment simulated from one initial state.

    Attributes:
        start: the free initial state around it.
        residual: (samples, joints) measured minus predicted positions, rad or m.
        misfit: sum of squared residuals with the free initial state, in noise standard deviations.
    """

    start: FreeInitialState
    residual: FloatArray
    misfit: float

    @property
    def motor_step(self) -> FloatArray:
        """(joints,) Gauss-Newton step of the initial motor positions, rad or m."""
        return self.start.motor_shift(self.residual)


class _InitialStateSearch:
    """Search for the initial motor positions of segments with the smallest misfit.

    Attributes:
        found: segment -> simulation from its best initial state.
        shifts: segment -> (joints,) shift of its initial motor positions; only segments with
            elastic transmissions.
        simulated_steps: number of simulated steps.
    """

    def __init__(
        self,
        simulator: BatchSimulator,
        noise: FloatArray,
        hypothesis: Hypothesis,
        scales: Scales,
        motor_deviations: FloatArray,
    ) -> None:
        self._simulator, self._noise = simulator, noise
        self._hypothesis, self._scales, self._motor_deviations = (
            hypothesis,
            scales,
            motor_deviations,
        )
        self.simulated_steps = 0
        none = np.zeros(len(simulator.joints))
        free = [i for i, s in enumerate(simulator.segments) if count_free_states(s)]
        self.found = self._simulate(dict.fromkeys(free, none))
        self.shifts = {i: none for i in self.found if motor_deviations[i].any()}

    def accept_better(self, tried: Mapping[int, FloatArray], share: float) -> list[int]:
        """Accept tried motor positions that reduce the misfit below a share of its value.

        Args:
            tried: segment -> (joints,) shift of its motors.
            share: share of the present misfit.

        Returns:
            The segments whose shift was accepted.
        """
        simulated = self._simulate(tried)
        better = [i for i, s in simulated.items() if s.misfit < share * self.found[i].misfit]
        self.found.update({i: simulated[i] for i in better})
        self.shifts.update({i: tried[i] for i in better})
        return better

    def _simulate(self, shifts: Mapping[int, FloatArray]) -> dict[int, _SimulatedStart]:
        """Simulate segments with shifted motors; those that diverge are left out."""
        known = self._simulator
        moved = {i: replace(known.segments[i], motor_shift=x) for i, x in shifts.items()}
        shifted = [_perturbed_segments(s, self._motor_deviations[i]) for i, s in moved.items()]
        if not shifted:
            return {}
        simulator = BatchSimulator(
            list(chain(*shifted)), known.joints, threads=known.threads, fixed=known.fixed
        )
        rows = np.arange(len(simulator.segments))
        values = effect_values([self._hypothesis] * len(rows), len(known.joints), self._scales)
        found = iter(simulator.simulate(rows, values))
        self.simulated_steps += simulator.simulated_steps
        out = {}
        for (i, s), each in zip(moved.items(), shifted, strict=True):
            base, *others = islice(found, len(each))
            response = [(p.position - base.position).ravel() / _STEP for p in others]
            if np.isfinite(response).all():
                of_shifts = np.stack(response, axis=1)
                start = free_initial_state(of_shifts, s, self._noise, self._motor_deviations[i])
                residual = s.position - base.position
                misfit = float(np.sum((start.without_initial_error(residual) / self._noise) ** 2))
                out[i] = _SimulatedStart(start, residual, misfit)
        return out


def _perturbed_segments(segment: Segment, motor_deviations: FloatArray) -> list[Segment]:
    """A segment, and copies with one element of the free initial state changed by a small step."""
    out, count = [segment], len(motor_deviations)
    for k in range(count_free_states(segment)):
        q, v = segment.initial_position.copy(), segment.initial_velocity.copy()
        (q if k < count else v)[k % count] += _STEP
        out.append(replace(segment, initial_position=q, initial_velocity=v))
    for j in np.flatnonzero(motor_deviations):
        motor = np.zeros(count) if segment.motor_shift is None else segment.motor_shift.copy()
        motor[j] += _STEP
        out.append(replace(segment, motor_shift=motor))
    return out


def _motor_deviations(
    simulator: BatchSimulator, hypothesis: Hypothesis, scales: Scales
) -> FloatArray:
    """(segments, joints) standard deviation of initial motor positions, rad or m.

    It is the deflection of an elastic transmission under the RMS effort, if the servo is a velocity
    servo; 0 otherwise.
    """
    segments, joints = simulator.segments, len(simulator.joints)
    out = np.zeros((len(segments), joints))
    rows = np.flatnonzero([s.mode == "velocity" for s in segments])
    laws = [*(t.law for t in hypothesis.terms), *(catalogue()[e] for e in simulator.fixed)]
    if len(rows) and any(law.is_elastic_transmission for law in laws):
        values = effect_values([hypothesis] * len(rows), joints, scales)
        out[rows] = simulator.transmission_deflection(rows, values, scales.of["effort"])
    return out


def free_initial_state(
    response: FloatArray,
    segment: Segment,
    noise: FloatArray,
    motors: FloatArray | None = None,
) -> FreeInitialState:
    """The free initial state of a segment: MAP estimate with a Gaussian prior.

    Args:
        response: (samples * joints, shifts) Jacobian of positions with respect to the state of the
            links, then to motors behind elastic transmissions.
        noise: (joints,) standard deviation of a position sample, rad or m.
        motors: (joints,) standard deviation of initial motor positions, rad or m; 0 with a rigid
            transmission, also the default.
    """
    weight = np.tile(1.0 / noise**2, len(response) // len(noise))
    motors = np.zeros(len(noise)) if motors is None else motors
    elastic = motors[motors > 0.0]
    links = response.shape[1] - len(elastic)
    prior = 1.0 / np.concatenate([_start_variance(segment, noise)[:links], elastic**2])
    normal = response.T @ (weight[:, None] * response) + np.diag(prior)
    # In a diverging motion all shifts have nearly the same response: use the minimum-norm solution.
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
    variance: FloatArray = np.outer(
        spread, noise**2 * _misfit_of_cubic(segment, noise, width)
    ).ravel()
    # A local cubic cannot follow a reversal exactly, so the prior is wider than noise alone gives.
    return 4.0 * variance


def _misfit_of_cubic(segment: Segment, noise: FloatArray, width: float) -> FloatArray:
    """(joints,) mean squared deviation from local cubics after the start, in noise variances; at
    least 1. It is 1 if no sample is so near (lost messages).
    """
    near = segment.time <= segment.start + width
    if segment.history is None or not near.any():
        return np.ones(len(noise))
    time, smooth, _ = segment.history
    line = np.stack([np.interp(segment.time[near], time, s) for s in smooth.T], axis=1)
    mean_square = np.mean((segment.position[near] - line) ** 2, axis=0)
    ratio: FloatArray = np.maximum(mean_square / noise**2, 1.0)
    return ratio
