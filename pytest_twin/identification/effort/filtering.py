"""Zero-phase filtering, differentiation and decimation of recorded motion.

The standard procedure of off-line identification (Gautier, Khalil, Restrepo, IEEE CDC 1995; Janot,
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
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.realization.driven_base import BaseStates

_ORDER = 4
"""Order of the Butterworth low-pass filter, which is applied forward and backward."""
_MOTION_SHARE = 0.99
"""Fraction of a velocity's power that is counted as motion. The rest is encoder noise."""
_ABOVE_NOISE = 10.0
"""Threshold of the spectrum, relative to the mean power of encoder noise. Noise itself exceeds it
in one of 22,000 spectral lines."""
_BELOW_PEAK = 1e-3
"""Smallest power of a band, relative to the joint's strongest band, that is counted as motion. The
noise of uneven stamps is not white: it exceeds the reference above, but stays 40 dB below the
motion."""
_BANDS_PER_OCTAVE = 3
"""Width of these bands."""
_ACCELERATION = 3.0
"""Ratio of the bandwidth of accelerations to that of velocities."""
_POSITION_CUTOFF = 10.0
"""Cutoff of the position filter, relative to the accelerations' bandwidth. The filter then changes
the motion by less than 0.01 %."""
_PARALLEL_CUTOFF, _RATE = 2.0, 5.0
"""Cutoff of the filter on regressor and effort, and sampling rate of the fit, relative to the
accelerations' bandwidth."""
_HIGHEST = 0.4
"""Largest cutoff of any filter, relative to the sampling rate."""
OVERSAMPLED = 10.0
"""Ratio of the rate at which regressors are computed to the rate of the fit."""


@dataclass(frozen=True, slots=True)
class Filter:
    """Cutoff frequencies and rate of the fit, Hz.

    Attributes:
        cutoff: cutoff of the zero-phase Butterworth low-pass of order 4 on positions.
        parallel: cutoff of the same low-pass on regressor and effort (parallel filter).
        rate: sampling rate of the fit.
    """

    cutoff: float
    parallel: float
    rate: float

    @property
    def words(self) -> str:
        """Describe the filtering in one sentence."""
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
        position, velocity, acceleration: (n, joints), SI units.
        effort: (n, joints) N*m or N, NaN where it is unknown.
        rate: sampling rate, Hz.
        base: motion of the floating base, where its pose was recorded.
    """

    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    effort: FloatArray
    rate: float
    base: BaseStates | None = None


def choose_filter(recordings: Sequence[MeasuredRecording]) -> Filter:
    """Choose one filter for all recordings, from the bandwidth of the fastest joint.

    The bandwidth of a joint is that of the recording in which it moves most, so that recordings
    in which it hardly moves do not change the filter: there it may only tremble, or turn abruptly.
    A cutoff frequency that ``signals:`` states takes precedence, for regressor and effort.
    """
    slowest = min(one.rate for one in recordings)
    stated = [one.filter_cutoff for one in recordings if one.filter_cutoff is not None]
    dynamic = min(stated) / _PARALLEL_CUTOFF if stated else _ACCELERATION * _bandwidth(recordings)
    highest = _HIGHEST * slowest
    return Filter(
        cutoff=min(_POSITION_CUTOFF * dynamic, highest),
        parallel=min(_PARALLEL_CUTOFF * dynamic, highest),
        rate=min(_RATE * dynamic, slowest),
    )


def differentiate(
    recording: MeasuredRecording, chosen: Filter, oversampled: float = OVERSAMPLED
) -> Motion:
    """Return motion with velocities and accelerations, at the rate of the regressors.

    Args:
        oversampled: ratio of that rate to the rate of the fit, at least.
    """
    even = resample_uniformly(recording)
    rate = recording.rate
    smooth = low_passed(even.position, chosen.cutoff, rate)
    velocity = np.gradient(smooth, 1.0 / rate, axis=0)
    acceleration = np.gradient(velocity, 1.0 / rate, axis=0)
    step = max(1, int(rate / (oversampled * chosen.rate)))
    # The effort is not filtered here, but later together with the regressor.
    effort = low_passed(even.effort, min(_HIGHEST * rate / step, _HIGHEST * rate), rate)
    return Motion(
        time=even.time[::step],
        position=smooth[::step],
        velocity=velocity[::step],
        acceleration=acceleration[::step],
        effort=effort[::step],
        rate=rate / step,
        base=None if recording.base is None
        else recording.base.states(recording.start + even.time[::step]),
    )  # fmt: skip


def decimate(values: FloatArray, rate: float, chosen: Filter) -> FloatArray:
    """Low-pass (n, ...) values with zero phase and decimate them to (m, ...) at the fit's rate.

    Columns with NaN stay NaN.
    """
    flat = values.reshape(len(values), -1)
    smooth = low_passed(flat, chosen.parallel, rate)
    step = max(1, round(rate / chosen.rate))
    return np.asarray(smooth[::step].reshape(-1, *values.shape[1:]))


def _bandwidth(recordings: Sequence[MeasuredRecording]) -> float:
    """Frequency, Hz, below which the velocity of every joint has nearly all of its power."""
    slowest = min(one.rate for one in recordings)
    most = np.zeros(recordings[0].position.shape[1])
    ends = np.full(len(most), np.inf)
    for recording in recordings:
        frequency, lines = _power(recording)
        power = _excited(frequency, lines)
        summed = np.cumsum(power, axis=0)
        # Lines of a longer recording are closer to one another.
        strength = summed[-1] * frequency[1]
        share = summed / np.maximum(summed[-1], 1e-300)
        end = frequency[np.argmax(share > _MOTION_SHARE, axis=0)]
        ends = np.where(strength > most, end, ends)
        most = np.maximum(strength, most)
    if not most.any():
        return slowest / 10.0
    # A joint with as much noise as motion is not used.
    sound = ends < slowest / 10.0
    return float(ends[sound].max()) if sound.any() else slowest / 50.0


def _excited(frequency: FloatArray, power: FloatArray) -> FloatArray:
    """(k, joints) power in the bands that the motion excites, 0 in the others.

    Args:
        frequency: (k,) Hz, increasing.
        power: (k, joints) energy of the velocities above the noise.
    """
    lowest = float(frequency[frequency > 0.0].min(initial=np.inf))
    octave = np.log2(np.maximum(frequency, lowest) / lowest)
    band = np.floor(_BANDS_PER_OCTAVE * octave).astype(np.intp)
    density = np.zeros((int(band.max()) + 1, power.shape[1]))
    np.add.at(density, band, power)
    width = lowest * 2.0 ** (np.arange(len(density)) / _BANDS_PER_OCTAVE)
    density /= width[:, None]
    excited = density >= _BELOW_PEAK * density.max(axis=0)
    return np.where(excited[band], power, 0.0)


def _power(recording: MeasuredRecording) -> tuple[FloatArray, FloatArray]:
    """Frequencies (k,) Hz, and the energy (k, joints) of the velocities there above the noise."""
    position = resample_uniformly(recording).position
    rate = recording.rate
    velocity: FloatArray = np.diff(position, axis=0) * rate
    velocity = velocity - velocity.mean(axis=0)
    window = np.hanning(len(velocity))[:, None]
    power = np.abs(np.fft.rfft(velocity * window, axis=0)) ** 2 / len(velocity) / rate
    frequency: FloatArray = np.asarray(np.fft.rfftfreq(len(velocity), 1.0 / rate), dtype=np.float64)
    # White position noise, differentiated, is the reference; motion must be well above its mean.
    shape = np.sin(np.pi * frequency / rate)[:, None] ** 2
    upper = slice(3 * len(frequency) // 4, None)
    noise = np.median(power[upper] / shape[upper], axis=0) / np.log(2.0) * shape
    power = np.where(power > _ABOVE_NOISE * noise, power, 0.0)
    return frequency, np.asarray(power, dtype=np.float64)


def resample_uniformly(recording: MeasuredRecording) -> MeasuredRecording:
    """Return the recording resampled at equal intervals."""
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
        position=_resample(even, time, recording.position),
        velocity=None,
        effort=_resample(even, time, recording.effort),
        command=None if command is None else _resample(even, time, command),
    )


def _resample(at: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    columns = []
    for column in values.T:
        known = np.isfinite(column)
        columns.append(
            np.interp(at, time[known], column[known]) if known.any() else np.full(len(at), np.nan)
        )
    return np.array(columns).T


@cache
def _sections(cutoff: float, rate: float) -> FloatArray:
    """Return the second-order sections of the low-pass (cached, because the design is costly)."""
    return np.asarray(signal.butter(_ORDER, cutoff, fs=rate, output="sos"))


def low_passed(values: FloatArray, cutoff: float, rate: float) -> FloatArray:
    """(n, k) values low-passed at ``cutoff`` Hz with zero phase; columns with NaN are unchanged."""
    if cutoff >= _HIGHEST * rate:
        return values
    sections = _sections(cutoff, rate)
    known = np.isfinite(values).all(axis=0)
    out = values.copy()
    pad = min(len(values) - 1, int(3 * rate / cutoff))
    out[:, known] = signal.sosfiltfilt(sections, values[:, known], axis=0, padlen=pad)
    return np.asarray(out)
