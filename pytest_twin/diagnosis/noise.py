"""How loud sensors are: what their samples, and the model, do not explain of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import nnls

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.segment import Predicted, Segment

# Samples that a cubic is fitted to, and its coefficients; of polynomials that follow fast motion at
# low rates, and how far they lie apart.
_NEIGHBOURS, _CUBIC = 15, 4
_FREE = _NEIGHBOURS - _CUBIC
_FEW, _SEVENTH, _APART = 12, 8, 4
# Groups of windows of like speed.
_SPEEDS = 12
# Share of the samples, those that the model's step changes least, that tell an effort's noise.
_QUIET = 0.3
# Of the largest effort that a sensor measured, the least that it resolves: a converter of 13 bits.
_FINEST_EFFORT = 1e-4


def sensor_noise(time: FloatArray, position: FloatArray) -> FloatArray:
    """(joints,) standard deviation of noise and quantization of (n, joints) samples at (n,) s.

    Three filters take out what is smooth, third differences, cubics through neighbours in time and
    polynomials of degree seven through fewer; each knows what it leaves of white noise. Fast motion
    gets through the second, at few samples a period through the first; the steps of a coarse
    encoder and irregular sampling are blown up by the first: the least is right. Medians keep
    reversals and impacts out.
    """
    step = np.array([_quantum(position[:, j]) for j in range(position.shape[1])])
    third = np.median(np.abs(np.diff(position, n=3, axis=0)), axis=0)
    # A median of counts is known to half a count.
    spread = 1.4826 * (third + 0.5 * step) / np.sqrt(20.0)
    if len(position) >= 2 * _NEIGHBOURS:
        spread = np.minimum(spread, _off_cubics(time, position))
        spread = np.minimum(spread, _off_seventh_degree(time, position))
    noise: FloatArray = np.maximum(spread, step / np.sqrt(12.0))
    return noise


def timing_jitter(time: FloatArray, position: FloatArray) -> float:
    """Standard deviation of stamps, s, about when (n, joints) samples were really taken.

    A sample that is late is off by its speed: what cubics through neighbours leave grows with its
    square. Medians over windows of like speed keep reversals and impacts out; the clock is one for
    all joints.
    """
    if len(time) < _SPEEDS * _NEIGHBOURS:
        return 0.0
    square, speed = _cubics(time, position)
    median = _median_square(_FREE)
    jitter = []
    for s, v in zip(square.T, speed.T, strict=True):
        bins = np.array_split(np.argsort(np.abs(v)), _SPEEDS)
        level = np.array([np.median(s[b]) for b in bins]) / median
        if not level.all():
            # An encoder whose counts stand still.
            continue
        fast = np.array([np.mean(v[b] ** 2) for b in bins])
        (_, slope), _ = nnls(np.stack([1.0 / level, fast / level], axis=1), np.ones(_SPEEDS))
        jitter.append(np.sqrt(slope))
    return float(np.median(jitter)) if jitter else 0.0


def _off_cubics(time: FloatArray, position: FloatArray) -> FloatArray:
    """(joints,) deviation of samples from cubics, one through every few neighbours."""
    square, _ = _cubics(time, position)
    spread: FloatArray = np.sqrt(np.median(square, axis=0) / _FREE)
    return spread


def _off_seventh_degree(time: FloatArray, position: FloatArray) -> FloatArray:
    """(joints,) deviation of samples from polynomials through fewer of them."""
    square, _ = _polynomials(time, position, _FEW, _SEVENTH, _APART)
    spread: FloatArray = np.sqrt(np.median(square, axis=0) / _median_square(_FEW - _SEVENTH))
    return spread


def _median_square(freedom: int) -> float:
    """Median of a chi-squared variable (Wilson, Hilferty 1931)."""
    return float(freedom * (1.0 - 2.0 / (9.0 * freedom)) ** 3)


def _cubics(time: FloatArray, position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(windows, joints) squares of samples off cubics through neighbours, and their speed."""
    return _polynomials(time, position, _NEIGHBOURS, _CUBIC, _NEIGHBOURS)


def _polynomials(
    time: FloatArray, position: FloatArray, neighbours: int, coefficients: int, apart: int
) -> tuple[FloatArray, FloatArray]:
    """(windows, joints) squares of samples off polynomials through as many neighbours, windows so
    many samples apart, and their speed.
    """
    first = np.arange(0, len(time) - neighbours + 1, apart)
    inside = first[:, None] + np.arange(neighbours)
    windows = time[inside]
    middle = 0.5 * (windows[:, :1] + windows[:, -1:])
    half = np.maximum(0.5 * (windows[:, -1:] - windows[:, :1]), 1e-12)
    powers = ((windows - middle) / half)[..., None] ** np.arange(coefficients)
    basis, triangle = np.linalg.qr(powers)
    samples = position[inside]
    along = basis.transpose(0, 2, 1) @ samples
    off = samples - basis @ along
    square: FloatArray = (off**2).sum(axis=1)
    return square, np.linalg.solve(triangle, along)[:, 1] / half


def _quantum(values: FloatArray) -> float:
    """The step of a quantized signal, or 0 where it is not quantized."""
    levels = np.unique(values)
    if len(levels) < 3:
        return 0.0
    gaps = np.diff(levels)
    smallest = float(np.quantile(gaps, 0.05))
    if smallest <= 0.0:
        return 0.0
    off = gaps / smallest
    return smallest if np.abs(off - np.round(off)).mean() < 0.02 else 0.0


def greatest_noise(
    segments: Sequence[Segment], values: Sequence[FloatArray], owner: Sequence[int]
) -> FloatArray:
    """(joints,) of the noisiest trial."""
    greatest: FloatArray = np.max(_by_trial(segments, values, owner), axis=0)
    return greatest


def _by_trial(
    segments: Sequence[Segment], values: Sequence[FloatArray], owner: Sequence[int]
) -> FloatArray:
    """(trials, joints) noise; the windows of one trial are taken together."""
    each = []
    for trial in sorted(set(owner)):
        mine = [i for i, o in enumerate(owner) if o == trial]
        time = np.concatenate([segments[i].time for i in mine])
        each.append(sensor_noise(time, np.concatenate([values[i] for i in mine])))
    return np.array(each)


def timing_noise(segments: Sequence[Segment], owner: Sequence[int]) -> FloatArray:
    """(joints,) what jitter of the stamps makes of positions, rad or m, in the worst trial; the
    noise has it in it.
    """
    each = []
    for trial in sorted(set(owner)):
        mine = [segments[i] for i, o in enumerate(owner) if o == trial]
        time = np.concatenate([s.time for s in mine])
        position = np.concatenate([s.position for s in mine])
        usual = np.zeros(position.shape[1])
        if len(time) >= 2 * _NEIGHBOURS:
            usual = np.sqrt(np.mean(_cubics(time, position)[1] ** 2, axis=0))
        each.append(timing_jitter(time, position) * usual)
    worst: FloatArray = np.max(each, axis=0)
    return worst


def effort_noise(
    segments: Sequence[Segment], nominal: Sequence[Predicted], owner: Sequence[int]
) -> FloatArray:
    """(joints,) deviation of measured efforts, N*m or N.

    A stiff servo's effort jumps at every command, which third differences take for noise where the
    model does not say the same. The sensor is one in all trials: the median is
    of one with few jumps.
    """
    efforts = [s.effort for s in segments if s.effort is not None]
    off = [e - p.effort for e, p in zip(efforts, nominal, strict=True)]
    each = np.minimum(_by_trial(segments, efforts, owner), _by_trial(segments, off, owner))
    usual: FloatArray = np.median(each, axis=0)
    return usual


def finest_effort(segments: Sequence[Segment]) -> FloatArray:
    """(joints,) least deviation of a measured effort, N*m or N: no sensor resolves a smaller part
    of the largest effort that it measured. Efforts of a simulation have no noise at all.
    """
    largest = np.max(
        [np.abs(s.effort).max(axis=0) for s in segments if s.effort is not None], axis=0
    )
    finest: FloatArray = _FINEST_EFFORT * largest
    return finest


def quiet_noise(problem: Problem, nominal: Sequence[Predicted], owner: Sequence[int]) -> FloatArray:
    """(joints,) deviation of measured efforts where the model's step is no matter, N*m or N.

    Efforts that jump do so in proportion to the model's: what third differences leave beside that
    is noise.
    """
    each = []
    for trial in sorted(set(owner)):
        measured, modelled, shaken = [], [], []
        for i, o in enumerate(owner):
            effort, add = problem.simulator.segments[i].effort, problem.defect.get(i)
            if o == trial and effort is not None and add is not None:
                measured.append(effort)
                modelled.append(nominal[i].effort + add.effort)
                shaken.append(np.abs(add.effort))
        if not measured:
            return np.full(len(problem.joints), np.inf)
        third, like = (np.diff(np.concatenate(x), n=3, axis=0) for x in (measured, modelled))
        shake = np.max(
            np.lib.stride_tricks.sliding_window_view(np.concatenate(shaken), 4, axis=0), axis=-1
        )
        quiet = shake <= np.quantile(shake, _QUIET, axis=0)
        found = np.zeros(len(problem.joints))
        for j in range(third.shape[1]):
            a, b = third[quiet[:, j], j], like[quiet[:, j], j]
            a = a - b * (a @ b) / max(float(b @ b), 1e-30)
            found[j] = 1.4826 * float(np.median(np.abs(a))) / np.sqrt(20.0)
        each.append(found)
    usual: FloatArray = np.median(each, axis=0)
    return usual
