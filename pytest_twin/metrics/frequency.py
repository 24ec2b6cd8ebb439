"""Periodic excitation signals, and frequency responses that they determine.

Commands repeat a whole number of times, and spectra are taken over whole periods after the
transients, so that there is no leakage between excited lines. Several realizations of the command
distinguish a linear system from a nonlinear one: nonlinear distortions change with the realization
and reduce the coherence (Pintelon and Schoukens, System Identification, 2nd ed., ch. 4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray

IntArray = NDArray[np.int64]

_CANDIDATES = 64  # number of random phase sets, of which that with the lowest crest factor is used
_EXCITED = 1e-3  # fraction of the largest amplitude below which a line is not excited
_PEAK_DB = 0.5  # smallest height of a resonance above both ends of the band, dB
_BANDWIDTH_DB = -20.0 * np.log10(np.sqrt(2.0))  # half the power


@dataclass(frozen=True, slots=True)
class Response:
    """A frequency response on the lines with sufficient coherence.

    Attributes:
        frequency: (n,) Hz, increasing.
        magnitude: (n,) response per command.
        phase: (n,) rad, unwrapped from the lowest line.
        coherence: (n,) 0 to 1.
        excited: (m,) all excited lines, Hz; ``frequency`` is a subset.
        best: the highest coherence of all excited lines.
    """

    frequency: FloatArray
    magnitude: FloatArray
    phase: FloatArray
    coherence: FloatArray
    excited: FloatArray
    best: float


def log_harmonics(lowest: int, highest: int, lines: int) -> IntArray:
    """At most ``lines`` harmonics from ``lowest`` to ``highest``, spaced geometrically."""
    spaced = np.geomspace(lowest, highest, lines)
    return np.unique(np.round(spaced).astype(np.int64))


def multisine(samples: int, harmonics: IntArray, seed: tuple[int, int]) -> FloatArray:
    """One period of a multisine with equal amplitudes and random phases, peak 1; (samples,).

    Of 64 random phase sets, the one with the lowest crest factor is used.

    Args:
        samples: number of samples of one period.
        harmonics: (k,) multiples of the fundamental frequency.
        seed: seed of the signal, and number of the realization.
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
    """One period of a linear sweep between two harmonics, peak 1, continuous when repeated.

    Realizations alternate in direction, sign and phase. The sum of the harmonics must be even, or
    the phase would jump by half a period; ``highest`` is lowered by one where it is odd.
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
    """Estimate the frequency response at ``harmonics``.

    The estimate is H1 over realizations and periods, ``S_yu / S_uu``, with the coherence
    ``|S_yu|^2 / (S_uu S_yy)`` (Bendat and Piersol, Random Data, ch. 6).

    Args:
        command, response: (realizations, periods, samples of one period).
        harmonics: (k,) lines to evaluate, multiples of 1 / ``period``.
        period: s.
        coherence: lines with a smaller coherence are left out.
    """
    u = np.fft.rfft(command, axis=-1)[..., harmonics].reshape(-1, harmonics.size)
    y = np.fft.rfft(response, axis=-1)[..., harmonics].reshape(-1, harmonics.size)
    power_u = np.sum(np.abs(u) ** 2, axis=0)
    power_y = np.sum(np.abs(y) ** 2, axis=0)
    cross = np.sum(y * np.conj(u), axis=0)
    excited = power_u >= _EXCITED**2 * power_u.max(initial=0.0)
    excited &= power_u > 0.0
    found = np.zeros(harmonics.size)
    responding = excited & (power_y > 0.0)
    found[responding] = np.abs(cross[responding]) ** 2 / (power_u[responding] * power_y[responding])
    sufficient = responding & (found >= coherence)
    gain = cross[sufficient] / power_u[sufficient]
    frequency = harmonics / period
    return Response(
        frequency=frequency[sufficient],
        magnitude=np.abs(gain),
        phase=np.unwrap(np.angle(gain)),
        coherence=found[sufficient],
        excited=frequency[excited],
        best=float(found.max(initial=0.0)),
    )


def decibel(ratio: FloatArray) -> FloatArray:
    """Amplitude ratios in dB: 20 log10."""
    return np.asarray(20.0 * np.log10(ratio))


def bandwidth(response: Response) -> float | None:
    """Frequency at which the magnitude first falls 3 dB below that of the lowest line, Hz.

    None if the magnitude does not fall that far, if the lowest excited line has too little
    coherence, if the crossing is in a gap between lines, or if it is within the first octave: then
    the response has no plateau, like an integrator.
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
    """Highest peak inside the band: frequency (Hz) and level above the lowest line (dB).

    It is the maximum of the parabola through the highest line and its neighbours, over the
    logarithm of frequency. None if no line is 0.5 dB above both ends of the band.
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
