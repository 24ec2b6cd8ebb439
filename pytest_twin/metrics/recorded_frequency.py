"""Frequency response of what was recorded: no period, no choice of lines, and noise.

Welch's averaged spectra; a line counts only where the command excites it and the coherence says
that the response follows (Bendat and Piersol, Random Data, 4th ed., ch. 6 and 9).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.metrics.frequency import Response

LEAST_COHERENCE = 0.8
"""Below, the random error of the magnitude is more than 10 % with twelve averages."""
_SEGMENTS = 12
"""Averages that a recording is cut for, each overlapping the next by half."""
_FEWEST_SAMPLES = 32
"""Of one segment."""
_EXCITED = 1e-3
"""Of the strongest line's amplitude: below it a line is not excited."""
_CHANCE = 0.01
"""Chance by which two unrelated signals may reach the coherence that is asked for."""


@dataclass(frozen=True, slots=True)
class Compared:
    """How far a predicted response is from a measured one.

    Attributes:
        magnitude: greatest difference, dB.
        phase: greatest difference, rad.
        magnitude_at, phase_at: Hz.
        lowest, highest: Hz, of the lines that the coherence supports.
        lines: how many.
    """

    magnitude: float
    phase: float
    magnitude_at: float
    phase_at: float
    lowest: float
    highest: float
    lines: int


def uniform(time: FloatArray, *series: FloatArray) -> tuple[float, tuple[FloatArray, ...]]:
    """Samples a second, and each series at equal intervals.

    Args:
        time: (n,) s, increasing.
        series: (n,) each.
    """
    step = float(np.median(np.diff(time)))
    grid = np.arange(time[0], time[-1] + 0.5 * step, step)
    return 1.0 / step, tuple(np.interp(grid, time, one) for one in series)


def recorded_response(command: FloatArray, response: FloatArray, rate: float) -> Response | None:
    """Response per command on the lines that excitation and coherence support.

    None where the recording is too short to average.

    Args:
        command, response: (n,) at equal intervals.
        rate: Hz.
    """
    length = 2 * len(command) // (_SEGMENTS + 1)
    if length < _FEWEST_SAMPLES:
        return None
    # Imported where it is used: it takes 0.6 s, and every check imports this module.
    from scipy import signal

    # The mean is taken off: the lowest line has none of the signal.
    frequency, cross = (x[1:] for x in signal.csd(command, response, fs=rate, nperseg=length))
    power_u = np.abs(signal.csd(command, command, fs=rate, nperseg=length)[1])[1:]
    power_y = np.abs(signal.csd(response, response, fs=rate, nperseg=length)[1])[1:]
    excited = (power_u >= _EXCITED**2 * power_u.max(initial=0.0)) & (power_u > 0.0)
    coherence = np.zeros(len(frequency))
    answered = excited & (power_y > 0.0)
    coherence[answered] = np.abs(cross[answered]) ** 2 / (power_u[answered] * power_y[answered])
    # What unrelated signals reach by chance with so many averages.
    by_chance = 1.0 - _CHANCE ** (1.0 / (_SEGMENTS - 1))
    carried = answered & (coherence >= max(LEAST_COHERENCE, by_chance))
    gain = cross[carried] / power_u[carried]
    return Response(
        frequency=np.asarray(frequency[carried]),
        magnitude=np.abs(gain),
        phase=np.unwrap(np.angle(gain)),
        coherence=coherence[carried],
        excited=np.asarray(frequency[excited]),
        best=float(coherence.max(initial=0.0)),
    )


def compared(
    command: FloatArray, predicted: FloatArray, measured: FloatArray, rate: float
) -> Compared | None:
    """How far a prediction's response is from the measured one, where both follow the command.

    None where no line is supported.

    Args:
        command, predicted, measured: (n,) at equal intervals.
        rate: Hz.
    """
    ours = recorded_response(command, predicted, rate)
    theirs = recorded_response(command, measured, rate)
    if ours is None or theirs is None:
        return None
    both, at, to = np.intersect1d(ours.frequency, theirs.frequency, return_indices=True)
    if not len(both):
        return None
    level = 20.0 * np.log10(ours.magnitude[at] / theirs.magnitude[to])
    turn = np.angle(np.exp(1j * (ours.phase[at] - theirs.phase[to])))
    worst, late = int(np.argmax(np.abs(level))), int(np.argmax(np.abs(turn)))
    return Compared(
        float(abs(level[worst])), float(abs(turn[late])), float(both[worst]), float(both[late]),
        float(both[0]), float(both[-1]), len(both),
    )  # fmt: skip
