"""Positions to velocities and accelerations without a phase lag, and fewer samples of all.

The usual way of off-line identification (Gautier, Khalil, Restrepo, IEEE CDC 1995; Janot,
Vandanjon, Gautier, IEEE Trans. Control Syst. Technol. 22, 2014): low-pass forward and backward,
differentiate by central differences, filter regressor and effort alike, decimate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy import signal

from pytest_twin.arrays import FloatArray
from pytest_twin.identification.measured import Measured

_ORDER = 4
_MOTION_SHARE = 0.99
"""Share of a velocity's power that counts as motion; the rest is noise of the encoder."""
_ABOVE_NOISE = 10.0
"""Times the mean power of the encoder's noise, which noise itself reaches once in 22,000 lines."""
_ACCELERATION = 3.0
"""Accelerations of the same motion reach this many times higher in frequency."""
_POSITION_CUTOFF = 10.0
"""Of the accelerations' bandwidth: the filter then changes the motion by less than 0.01 %."""
_PARALLEL_CUTOFF, _RATE = 2.0, 5.0
"""Of the accelerations' bandwidth: what is fitted, and how many samples a second."""
_HIGHEST = 0.4
"""Of the sampling rate: no filter is placed above."""
_OVERSAMPLED = 10.0
"""Regressors are computed at this many times the rate that is fitted, before their own filter."""


@dataclass(frozen=True, slots=True)
class Filter:
    """How motion is filtered, Hz.

    Attributes:
        cutoff: of the zero-phase Butterworth low-pass of order 4 on positions.
        parallel: cutoff of the one on regressor and effort alike.
        rate: samples a second that are fitted.
    """

    cutoff: float
    parallel: float
    rate: float

    @property
    def words(self) -> str:
        """What is done, as one sentence."""
        return (
            f"positions are low-passed at {self.cutoff:.3g} Hz (Butterworth of order {_ORDER}, "
            "forward and backward) and differentiated by central differences; regressor and "
            f"effort are low-passed at {self.parallel:.3g} Hz and decimated to {self.rate:.3g} Hz"
        )


@dataclass(frozen=True)
class Motion:
    """Motion and effort at equal intervals.

    Attributes:
        time: (n,) s.
        position, velocity, acceleration: (n, joints).
        effort: (n, joints), NaN where it is unknown.
        rate: Hz.
    """

    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    effort: FloatArray
    rate: float


def choose_filter(recordings: Sequence[Measured]) -> Filter:
    """A filter for all recordings, from the bandwidth of their fastest joint."""
    bandwidth = max(_bandwidth(one) for one in recordings)
    slowest = min(one.rate for one in recordings)
    dynamic = _ACCELERATION * bandwidth
    highest = _HIGHEST * slowest
    return Filter(
        cutoff=min(_POSITION_CUTOFF * dynamic, highest),
        parallel=min(_PARALLEL_CUTOFF * dynamic, highest),
        rate=min(_RATE * dynamic, slowest),
    )


def differentiate(recording: Measured, chosen: Filter) -> Motion:
    """Velocities and accelerations of a recording, at the rate where regressors are computed."""
    even = uniform(recording)
    rate = recording.rate
    smooth = low_passed(even.position, chosen.cutoff, rate)
    velocity = np.gradient(smooth, 1.0 / rate, axis=0)
    acceleration = np.gradient(velocity, 1.0 / rate, axis=0)
    step = max(1, int(rate / (_OVERSAMPLED * chosen.rate)))
    # The effort is not low-passed with the positions: its own filter follows with the regressor's.
    effort = low_passed(even.effort, min(_HIGHEST * rate / step, _HIGHEST * rate), rate)
    return Motion(
        time=even.time[::step],
        position=smooth[::step],
        velocity=velocity[::step],
        acceleration=acceleration[::step],
        effort=effort[::step],
        rate=rate / step,
    )


def decimated(values: FloatArray, rate: float, chosen: Filter) -> FloatArray:
    """(m, ...) values (n, ...) low-passed without a phase lag, at the rate that is fitted.

    Columns with NaN stay NaN.
    """
    flat = values.reshape(len(values), -1)
    smooth = low_passed(flat, chosen.parallel, rate)
    step = max(1, round(rate / chosen.rate))
    return np.asarray(smooth[::step].reshape(-1, *values.shape[1:]))


def _bandwidth(recording: Measured) -> float:
    """Hz, below which the velocity of every joint has nearly all of its power."""
    position = uniform(recording).position
    rate = recording.rate
    moved = np.ptp(position, axis=0) > 0
    if not moved.any():
        return rate / 10.0
    velocity: FloatArray = np.diff(position[:, moved], axis=0)
    velocity = velocity - velocity.mean(axis=0)
    window = np.hanning(len(velocity))[:, None]
    power = np.abs(np.fft.rfft(velocity * window, axis=0)) ** 2
    frequency = np.fft.rfftfreq(len(velocity), 1.0 / rate)
    # White noise of the position, differenced; motion is what is well above its mean.
    shape = np.sin(np.pi * frequency / rate)[:, None] ** 2
    upper = slice(3 * len(frequency) // 4, None)
    noise = np.median(power[upper] / shape[upper], axis=0) / np.log(2.0) * shape
    power = np.where(power > _ABOVE_NOISE * noise, power, 0.0)
    share = np.cumsum(power, axis=0) / np.maximum(power.sum(axis=0), 1e-300)
    ends = frequency[np.argmax(share > _MOTION_SHARE, axis=0)]
    # A joint whose noise is as strong as its motion does not determine the motion.
    sound = ends < rate / 10.0
    return float(ends[sound].max()) if sound.any() else rate / 50.0


def uniform(recording: Measured) -> Measured:
    """The recording at equal intervals."""
    time = recording.time
    step = 1.0 / recording.rate
    count = int(np.floor(time[-1] / step + 1e-6)) + 1
    even: FloatArray = step * np.arange(count, dtype=np.float64)
    if count == len(time) and np.allclose(even, time, atol=1e-3 * step):
        return recording
    command = recording.command
    return replace(
        recording,
        time=even,
        position=_resampled(even, time, recording.position),
        velocity=None,
        effort=_resampled(even, time, recording.effort),
        command=None if command is None else _resampled(even, time, command),
    )


def _resampled(at: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    columns = []
    for column in values.T:
        known = np.isfinite(column)
        columns.append(
            np.interp(at, time[known], column[known]) if known.any() else np.full(len(at), np.nan)
        )
    return np.array(columns).T


@cache
def _sections(cutoff: float, rate: float) -> FloatArray:
    """Second-order sections of the low-pass; designing it costs as much as applying it."""
    return np.asarray(signal.butter(_ORDER, cutoff, fs=rate, output="sos"))


def low_passed(values: FloatArray, cutoff: float, rate: float) -> FloatArray:
    """(n, k) values without a phase lag below ``cutoff`` Hz; columns with NaN stay as they are."""
    if cutoff >= _HIGHEST * rate:
        return values
    sections = _sections(cutoff, rate)
    known = np.isfinite(values).all(axis=0)
    out = values.copy()
    pad = min(len(values) - 1, int(3 * rate / cutoff))
    out[:, known] = signal.sosfiltfilt(sections, values[:, known], axis=0, padlen=pad)
    return np.asarray(out)
