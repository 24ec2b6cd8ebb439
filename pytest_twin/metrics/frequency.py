"""Periodic excitation, and what of a frequency response it carries.

Commands repeat a whole number of times, and spectra are taken over whole periods after the
transients: every excited line falls on its own bin and none leaks into another. Several
realizations of the command tell a linear system from a nonlinear one: what a nonlinearity adds
changes with the realization and lowers the coherence (Pintelon and Schoukens, System
Identification, 2nd ed., ch. 4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray

IntArray = NDArray[np.int64]

_CANDIDATES = 64  # random phases that compete for the lowest crest
_EXCITED = 1e-3  # of the strongest line's amplitude: below it a line is not excited
_PEAK_DB = 0.5  # a lower peak over both ends of the band is no resonance
_BANDWIDTH_DB = -20.0 * np.log10(np.sqrt(2.0))  # half the power


@dataclass(frozen=True, slots=True)
class Response:
    """A frequency response on the lines that are carried.

    Attributes:
        frequency: (n,) Hz, increasing.
        magnitude: (n,) response per command.
        phase: (n,) rad, unwrapped from the lowest line on.
        coherence: (n,) 0 to 1.
        excited: (m,) Hz, all lines that were excited; ``frequency`` is a subset.
        best: the highest coherence of any excited line.
    """

    frequency: FloatArray
    magnitude: FloatArray
    phase: FloatArray
    coherence: FloatArray
    excited: FloatArray
    best: float


def log_harmonics(lowest: int, highest: int, lines: int) -> IntArray:
    """At most ``lines`` different harmonics from ``lowest`` to ``highest``, spaced by ratio."""
    spaced = np.geomspace(lowest, highest, lines)
    return np.unique(np.round(spaced).astype(np.int64))


def multisine(samples: int, harmonics: IntArray, seed: tuple[int, int]) -> FloatArray:
    """One period of a sum of equal sines with random phases, peak 1.

    Of 64 draws the one with the lowest crest factor is taken.

    Args:
        samples: of one period.
        harmonics: (k,) multiples of the period's frequency.
        seed: of the signal and of the realization.
    """
    generator = np.random.default_rng(seed)
    spectrum = np.zeros((_CANDIDATES, samples // 2 + 1), dtype=np.complex128)
    phase = generator.uniform(0.0, 2.0 * np.pi, (_CANDIDATES, harmonics.size))
    spectrum[:, harmonics] = np.exp(1j * phase)
    signals = np.fft.irfft(spectrum, samples, axis=1)
    peaks = np.abs(signals).max(axis=1)
    best = int(np.argmin(peaks / np.sqrt(np.mean(signals**2, axis=1))))
    return np.asarray(signals[best] / peaks[best])


def chirp(samples: int, lowest: int, highest: int, realization: int) -> FloatArray:
    """One period of a linear sweep between two harmonics, peak 1, that joins itself smoothly.

    Realizations alternate in direction, sign and phase. The sum of the harmonics is even, or the
    period would end half a turn off: ``highest`` is lowered by one where it is not.
    """
    highest -= (lowest + highest) % 2
    t = np.arange(samples) / samples
    phase = 2.0 * np.pi * (lowest * t + 0.5 * (highest - lowest) * t**2)
    signal = np.sin(phase + 0.5 * np.pi * (realization // 4))
    if realization % 2:
        signal = signal[::-1]
    return np.asarray(-signal if realization // 2 % 2 else signal)


def frequency_response(
    command: FloatArray,
    response: FloatArray,
    harmonics: IntArray,
    period: float,
    *,
    coherence: float,
) -> Response:
    """Estimate response per command at ``harmonics``.

    The H1 estimator over realizations and periods, ``S_yu / S_uu``, and the coherence
    ``|S_yu|^2 / (S_uu S_yy)`` (Bendat and Piersol, Random Data, ch. 6).

    Args:
        command, response: (realizations, periods, samples of one period).
        harmonics: (k,) lines to look at, multiples of 1 / ``period``.
        period: s.
        coherence: lines below it are not carried.
    """
    u = np.fft.rfft(command, axis=-1)[..., harmonics].reshape(-1, harmonics.size)
    y = np.fft.rfft(response, axis=-1)[..., harmonics].reshape(-1, harmonics.size)
    power_u = np.sum(np.abs(u) ** 2, axis=0)
    power_y = np.sum(np.abs(y) ** 2, axis=0)
    cross = np.sum(y * np.conj(u), axis=0)
    excited = power_u >= _EXCITED**2 * power_u.max(initial=0.0)
    excited &= power_u > 0.0
    found = np.zeros(harmonics.size)
    answered = excited & (power_y > 0.0)
    found[answered] = np.abs(cross[answered]) ** 2 / (power_u[answered] * power_y[answered])
    carried = answered & (found >= coherence)
    gain = cross[carried] / power_u[carried]
    frequency = harmonics / period
    return Response(
        frequency=frequency[carried],
        magnitude=np.abs(gain),
        phase=np.unwrap(np.angle(gain)),
        coherence=found[carried],
        excited=frequency[excited],
        best=float(found.max(initial=0.0)),
    )


def decibel(ratio: FloatArray) -> FloatArray:
    """20 log10 of amplitudes."""
    return np.asarray(20.0 * np.log10(ratio))


def bandwidth(response: Response) -> float | None:
    """Hz where the magnitude first falls 3 dB (half the power) below that of the lowest line.

    None where it does not fall that far on the lines that are carried, where the lowest excited
    line is not carried, where the fall lies in a gap, or where it falls within the first octave:
    then there is no plateau to fall from, as of an integrator.
    """
    if response.frequency.size < 2 or response.frequency[0] != response.excited[0]:
        return None
    level = decibel(response.magnitude / response.magnitude[0])
    below = np.flatnonzero(level < _BANDWIDTH_DB)
    if below.size == 0:
        return None
    k = int(below[0])
    line = np.searchsorted(response.excited, response.frequency[k - 1 : k + 1])
    if line[1] - line[0] != 1 or response.frequency[k] <= 2.0 * response.frequency[0]:
        return None
    share = (_BANDWIDTH_DB - level[k - 1]) / (level[k] - level[k - 1])
    low, high = np.log(response.frequency[k - 1 : k + 1])
    return float(np.exp(low + share * (high - low)))


def resonance(response: Response) -> tuple[float, float] | None:
    """(Hz, dB over the lowest line) of the highest peak inside the band.

    The peak of the parabola through the three highest neighbours, over the logarithm of
    frequency. None where no line stands 0.5 dB above both ends of what is carried.
    """
    if response.frequency.size < 3:
        return None
    level = decibel(response.magnitude / response.magnitude[0])
    k = int(np.argmax(level))
    if not 0 < k < level.size - 1 or level[k] - max(level[0], level[-1]) < _PEAK_DB:
        return None
    x = np.log(response.frequency[k - 1 : k + 2])
    a, b, c = np.polyfit(x - x[1], level[k - 1 : k + 2], 2)
    offset = -b / (2.0 * a)
    return float(np.exp(x[1] + offset)), float(c + b * offset / 2.0)
