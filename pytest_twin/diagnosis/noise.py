"""Estimates of sensor noise and of timing jitter from recorded samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import nnls

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.noise_settings import NOISE_ESTIMATE
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.segment import Predicted, Segment

# Coefficients of a cubic, and of a polynomial of degree seven.
_CUBIC, _SEVENTH = 4, 8


def sensor_noise(time: FloatArray, position: FloatArray) -> FloatArray:
    """(joints,) standard deviation of noise and quantization.

    Three filters remove the smooth motion: third differences, local cubics, and local polynomials
    of degree seven. Each is scaled by its response to white noise. Fast motion passes the cubics,
    and at few samples a period also the third differences. Third differences amplify coarse
    quantization and irregular sampling. All errors increase the estimate, so the smallest of the
    three is taken. Medians exclude reversals and impacts.

    Args:
        time: (n,) s.
        position: (n, joints) rad or m.
    """
    step = np.array([_quantization_step(position[:, j]) for j in range(position.shape[1])])
    third = np.median(np.abs(np.diff(position, n=3, axis=0)), axis=0)
    # The median of quantized values is uncertain by half a quantization step.
    spread = 1.4826 * (third + 0.5 * step) / np.sqrt(20.0)
    if len(position) >= 2 * NOISE_ESTIMATE.neighbours:
        spread = np.minimum(spread, _deviation_from_cubics(time, position))
        spread = np.minimum(spread, _deviation_from_seventh_degree(time, position))
    noise: FloatArray = np.maximum(spread, step / np.sqrt(12.0))
    return noise


def timing_jitter(time: FloatArray, position: FloatArray) -> float:
    """Standard deviation of the error of the stamps, s.

    A timing error shifts a sample in proportion to its speed. The residual variance of local cubics
    therefore grows with the squared speed. Medians over windows of similar speed exclude reversals
    and impacts. All joints share one clock, so the median over joints is returned.

    Args:
        time: (n,) s.
        position: (n, joints) rad or m.
    """
    if len(time) < NOISE_ESTIMATE.speed_groups * NOISE_ESTIMATE.neighbours:
        return 0.0
    square, speed = _fit_cubics(time, position)
    median = _median_square(NOISE_ESTIMATE.neighbours - _CUBIC)
    jitter = []
    for s, v in zip(square.T, speed.T, strict=True):
        bins = np.array_split(np.argsort(np.abs(v)), NOISE_ESTIMATE.speed_groups)
        level = np.array([np.median(s[b]) for b in bins]) / median
        if not level.all():
            # The encoder reads the same count in some windows.
            continue
        fast = np.array([np.mean(v[b] ** 2) for b in bins])
        (_, slope), _ = nnls(
            np.stack([1.0 / level, fast / level], axis=1), np.ones(NOISE_ESTIMATE.speed_groups)
        )
        jitter.append(np.sqrt(slope))
    return float(np.median(jitter)) if jitter else 0.0


def _deviation_from_cubics(time: FloatArray, position: FloatArray) -> FloatArray:
    """(joints,) standard deviation of samples from local cubics."""
    square, _ = _fit_cubics(time, position)
    spread: FloatArray = np.sqrt(np.median(square, axis=0) / (NOISE_ESTIMATE.neighbours - _CUBIC))
    return spread


def _deviation_from_seventh_degree(time: FloatArray, position: FloatArray) -> FloatArray:
    """(joints,) standard deviation of samples from local polynomials of degree seven."""
    square, _ = _fit_polynomials(
        time, position, NOISE_ESTIMATE.few_neighbours, _SEVENTH, NOISE_ESTIMATE.apart
    )
    spread: FloatArray = np.sqrt(
        np.median(square, axis=0) / _median_square(NOISE_ESTIMATE.few_neighbours - _SEVENTH)
    )
    return spread


def _median_square(freedom: int) -> float:
    """Median of a chi-squared variable (Wilson, Hilferty 1931)."""
    return float(freedom * (1.0 - 2.0 / (9.0 * freedom)) ** 3)


def _fit_cubics(time: FloatArray, position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sums of squared deviations from local cubics, and velocities, (windows, joints) each."""
    return _fit_polynomials(
        time, position, NOISE_ESTIMATE.neighbours, _CUBIC, NOISE_ESTIMATE.neighbours
    )


def _fit_polynomials(
    time: FloatArray, position: FloatArray, neighbours: int, coefficients: int, stride: int
) -> tuple[FloatArray, FloatArray]:
    """Sums of squared deviations from local polynomials, and velocities, (windows, joints) each.

    Args:
        time: (n,) s.
        position: (n, joints) rad or m.
        neighbours: number of samples in a window.
        coefficients: number of coefficients of the polynomial.
        stride: distance between the beginnings of windows, in samples.
    """
    first = np.arange(0, len(time) - neighbours + 1, stride)
    inside = first[:, None] + np.arange(neighbours)
    windows = time[inside]
    middle = 0.5 * (windows[:, :1] + windows[:, -1:])
    half = np.maximum(0.5 * (windows[:, -1:] - windows[:, :1]), 1e-12)
    powers = ((windows - middle) / half)[..., None] ** np.arange(coefficients)
    basis, triangle = np.linalg.qr(powers)
    samples = position[inside]
    projected = basis.transpose(0, 2, 1) @ samples
    residual = samples - basis @ projected
    square: FloatArray = (residual**2).sum(axis=1)
    return square, np.linalg.solve(triangle, projected)[:, 1] / half


def _quantization_step(values: FloatArray) -> float:
    """The quantization step of a signal; 0 if it is not quantized."""
    levels = np.unique(values)
    if len(levels) < 3:
        return 0.0
    gaps = np.diff(levels)
    smallest = float(np.quantile(gaps, 0.05))
    if smallest <= 0.0:
        return 0.0
    multiples = gaps / smallest
    return smallest if np.abs(multiples - np.round(multiples)).mean() < 0.02 else 0.0


def largest_noise(
    segments: Sequence[Segment], values: Sequence[FloatArray], owner: Sequence[int]
) -> FloatArray:
    """(joints,) noise in the noisiest trial.

    Args:
        segments: segments of all trials.
        values: (samples, joints) of each segment.
        owner: index of the trial of each segment.
    """
    largest: FloatArray = np.max(_by_trial(segments, values, owner), axis=0)
    return largest


def _by_trial(
    segments: Sequence[Segment], values: Sequence[FloatArray], owner: Sequence[int]
) -> FloatArray:
    """(trials, joints) noise; the windows of one trial are evaluated together."""
    each = []
    for trial in sorted(set(owner)):
        of_trial = [i for i, o in enumerate(owner) if o == trial]
        time = np.concatenate([segments[i].time for i in of_trial])
        each.append(sensor_noise(time, np.concatenate([values[i] for i in of_trial])))
    return np.array(each)


def timing_noise(segments: Sequence[Segment], owner: Sequence[int]) -> FloatArray:
    """(joints,) RMS position error from the jitter of the stamps in the worst trial, rad or m.

    :func:`sensor_noise` contains it. Arguments are as in :func:`largest_noise`.
    """
    each = []
    for trial in sorted(set(owner)):
        of_trial = [segments[i] for i, o in enumerate(owner) if o == trial]
        time = np.concatenate([s.time for s in of_trial])
        position = np.concatenate([s.position for s in of_trial])
        rms_speed = np.zeros(position.shape[1])
        if len(time) >= 2 * NOISE_ESTIMATE.neighbours:
            rms_speed = np.sqrt(np.mean(_fit_cubics(time, position)[1] ** 2, axis=0))
        each.append(timing_jitter(time, position) * rms_speed)
    worst: FloatArray = np.max(each, axis=0)
    return worst


def effort_noise(
    segments: Sequence[Segment], nominal: Sequence[Predicted], owner: Sequence[int]
) -> FloatArray:
    """(joints,) standard deviation of measured efforts, N*m or N.

    The effort of a stiff servo jumps at every command, and third differences count a jump as noise.
    The noise is therefore also estimated after subtraction of the model's effort, and the smaller
    estimate is used. All trials have the same sensor, so the median over trials is returned.

    Args:
        segments: segments of all trials.
        nominal: their predictions by the nominal model.
        owner: index of the trial of each segment.
    """
    efforts = [s.effort for s in segments if s.effort is not None]
    errors = [e - p.effort for e, p in zip(efforts, nominal, strict=True)]
    each = np.minimum(_by_trial(segments, efforts, owner), _by_trial(segments, errors, owner))
    median: FloatArray = np.median(each, axis=0)
    return median


def effort_resolution(segments: Sequence[Segment]) -> FloatArray:
    """(joints,) smallest plausible standard deviation of measured efforts, N*m or N.

    It is the resolution of a sensor for the largest measured effort. It matters for recordings of a
    simulation, whose efforts have no noise.
    """
    largest = np.max(
        [np.abs(s.effort).max(axis=0) for s in segments if s.effort is not None], axis=0
    )
    resolution: FloatArray = NOISE_ESTIMATE.finest_effort * largest
    return resolution


def effort_noise_of_quiet_samples(
    problem: Problem, nominal: Sequence[Predicted], owner: Sequence[int]
) -> FloatArray:
    """(joints,) standard deviation of efforts, from samples with little discretization error.

    Jumps of the measured effort are proportional to those of the model. The noise is estimated from
    third differences after subtraction of the proportional part. Unit N*m or N; infinite if a trial
    has no effort.
    """
    each = []
    for trial in sorted(set(owner)):
        measured, modelled, step_error = [], [], []
        for i, o in enumerate(owner):
            effort, add = problem.simulator.segments[i].effort, problem.discretization_error.get(i)
            if o == trial and effort is not None and add is not None:
                measured.append(effort)
                modelled.append(nominal[i].effort + add.effort)
                step_error.append(np.abs(add.effort))
        if not measured:
            return np.full(len(problem.joints), np.inf)
        third, modelled_third = (
            np.diff(np.concatenate(x), n=3, axis=0) for x in (measured, modelled)
        )
        windows = np.lib.stride_tricks.sliding_window_view(np.concatenate(step_error), 4, axis=0)
        largest = np.max(windows, axis=-1)
        quiet = largest <= np.quantile(largest, NOISE_ESTIMATE.quiet_share, axis=0)
        found = np.zeros(len(problem.joints))
        for j in range(third.shape[1]):
            a, b = third[quiet[:, j], j], modelled_third[quiet[:, j], j]
            a = a - b * (a @ b) / max(float(b @ b), 1e-30)
            found[j] = 1.4826 * float(np.median(np.abs(a))) / np.sqrt(20.0)
        each.append(found)
    median: FloatArray = np.median(each, axis=0)
    return median
