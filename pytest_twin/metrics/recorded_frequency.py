"""Frequency responses from recordings without periodic excitation and with noise.

The spectra are averaged by Welch's method. A line is used only if the command excites it and the
coherence is sufficient (Bendat and Piersol, Random Data, 4th ed., ch. 6 and 9).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.metrics.frequency import Response, bandwidth, resonance
from pytest_twin.metrics.spectrum import cross_density, power_density

MIN_COHERENCE = 0.8
"""Smallest coherence; below it, the random error of the magnitude exceeds 10 % with 12 averages."""
_SEGMENTS = 12
"""Number of averaged segments of a recording, each overlapping the next by half."""
_MIN_SEGMENT_SAMPLES = 32
"""Smallest number of samples of a segment."""
_EXCITED = 1e-3
"""Fraction of the largest amplitude below which a line is not excited."""
_CHANCE = 0.01
"""Probability with which two unrelated signals may reach the required coherence."""


@dataclass(frozen=True, slots=True)
class ResponseDifference:
    """Difference between a predicted and a measured frequency response.

    Attributes:
        magnitude: largest difference of the magnitude, dB.
        phase: largest difference of the phase, rad.
        magnitude_at, phase_at: frequencies of these differences, Hz.
        lowest, highest: lowest and highest line with sufficient coherence, Hz.
        lines: number of these lines.
        bandwidth, resonance: differences of the bandwidths and of the resonances, Hz; None if one
            of the two responses shows none.
        bandwidth_predicted, bandwidth_measured: the bandwidths, Hz, or None.
        resonance_predicted, resonance_measured: frequencies of the resonances, Hz, or None.
    """

    magnitude: float
    phase: float
    magnitude_at: float
    phase_at: float
    lowest: float
    highest: float
    lines: int
    bandwidth: float | None = None
    bandwidth_predicted: float | None = None
    bandwidth_measured: float | None = None
    resonance: float | None = None
    resonance_predicted: float | None = None
    resonance_measured: float | None = None


def resample_uniformly(
    time: FloatArray, *series: FloatArray
) -> tuple[float, tuple[FloatArray, ...]]:
    """Resample series to equal intervals by linear interpolation; the sampling rate (Hz) first.

    Args:
        time: (n,) s, increasing.
        series: each (n,).
    """
    step = float(np.median(np.diff(time)))
    grid = np.arange(time[0], time[-1] + 0.5 * step, step)
    return 1.0 / step, tuple(np.interp(grid, time, one) for one in series)


def recorded_response(command: FloatArray, response: FloatArray, rate: float) -> Response | None:
    """Frequency response on the lines with sufficient excitation and coherence.

    None if the recording is too short.

    Args:
        command, response: (n,) signals at equal intervals.
        rate: sampling rate, Hz.
    """
    length = 2 * len(command) // (_SEGMENTS + 1)
    if length < _MIN_SEGMENT_SAMPLES:
        return None
    # The mean is removed, so that the line at 0 Hz contains no signal.
    frequency, cross = (x[1:] for x in cross_density(command, response, rate, length))
    power_u, power_y = (power_density(x, rate, length)[1][1:] for x in (command, response))
    excited = (power_u >= _EXCITED**2 * power_u.max(initial=0.0)) & (power_u > 0.0)
    coherence = np.zeros(len(frequency))
    responding = excited & (power_y > 0.0)
    coherence[responding] = np.abs(cross[responding]) ** 2 / (
        power_u[responding] * power_y[responding]
    )
    # Coherence that unrelated signals reach with probability _CHANCE.
    by_chance = 1.0 - _CHANCE ** (1.0 / (_SEGMENTS - 1))
    sufficient = responding & (coherence >= max(MIN_COHERENCE, by_chance))
    gain = cross[sufficient] / power_u[sufficient]
    return Response(
        frequency=np.asarray(frequency[sufficient]),
        magnitude=np.abs(gain),
        phase=np.unwrap(np.angle(gain)),
        coherence=coherence[sufficient],
        excited=np.asarray(frequency[excited]),
        best=float(coherence.max(initial=0.0)),
    )


def compare_responses(
    command: FloatArray, predicted: FloatArray, measured: FloatArray, rate: float
) -> ResponseDifference | None:
    """Compare the frequency responses of a prediction and a measurement to the same command.

    None if no line has sufficient coherence in both.

    Args:
        command, predicted, measured: (n,) signals at equal intervals.
        rate: sampling rate, Hz.
    """
    return response_difference(
        recorded_response(command, predicted, rate), recorded_response(command, measured, rate)
    )


def response_difference(
    predicted: Response | None, measured: Response | None
) -> ResponseDifference | None:
    """Return the difference of two responses; None if no line has sufficient coherence in both."""
    if predicted is None or measured is None:
        return None
    both, at, to = np.intersect1d(predicted.frequency, measured.frequency, return_indices=True)
    if not len(both):
        return None
    level = 20.0 * np.log10(predicted.magnitude[at] / measured.magnitude[to])
    turn = np.angle(np.exp(1j * (predicted.phase[at] - measured.phase[to])))
    worst, late = int(np.argmax(np.abs(level))), int(np.argmax(np.abs(turn)))
    widths = bandwidth(predicted), bandwidth(measured)
    peaks = [None if peak is None else peak[0] for peak in map(resonance, (predicted, measured))]
    return ResponseDifference(
        float(abs(level[worst])), float(abs(turn[late])), float(both[worst]), float(both[late]),
        float(both[0]), float(both[-1]), len(both),
        _absolute_difference(*widths), *widths, _absolute_difference(*peaks), *peaks,
    )  # fmt: skip


def _absolute_difference(one: float | None, other: float | None) -> float | None:
    return None if one is None or other is None else abs(one - other)
