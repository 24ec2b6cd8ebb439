"""Spectral densities of signals by Welch's method."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray


def power_density(
    values: FloatArray, rate: float, size: int, *, padded: int | None = None, centred: bool = True
) -> tuple[FloatArray, FloatArray]:
    """Frequencies in Hz, and power per Hz averaged over parts that overlap by half (Welch 1967).

    ``scipy.signal.welch`` gives the same numbers. Its import takes longer than a quick diagnosis.

    Args:
        values: (n,) signal at regular times.
        rate: samples per second.
        size: samples of a part, at most n. Each part has a Hann window.
        padded: length of the Fourier transform; ``size`` by default.
        centred: whether the mean of each part is subtracted.

    Returns:
        Two arrays of ``padded // 2 + 1`` numbers. The power is one-sided: its integral over
        frequency is the mean square of the signal.
    """
    length = size if padded is None else padded
    power: FloatArray = np.mean(np.abs(_transforms(values, size, length, centred=centred)) ** 2, 0)
    return _frequencies(length, rate), power / _divisor(length, rate, size)


def cross_density(
    first: FloatArray, second: FloatArray, rate: float, size: int
) -> tuple[FloatArray, NDArray[np.complex128]]:
    """Frequencies in Hz, and cross-spectral density per Hz, averaged as :func:`power_density`.

    The argument of a number is the phase by which ``second`` leads ``first``.
    ``scipy.signal.csd`` gives the same numbers.

    Args:
        first, second: (n,) signals at the same regular times.
        rate: samples per second.
        size: samples of a part, at most n.
    """
    one, other = (_transforms(x, size, size, centred=True) for x in (first, second))
    found: NDArray[np.complex128] = np.mean(one.conj() * other, axis=0)
    return _frequencies(size, rate), found / _divisor(size, rate, size)


def _transforms(
    values: FloatArray, size: int, length: int, *, centred: bool
) -> NDArray[np.complex128]:
    """(parts, length // 2 + 1) Fourier transforms of the parts with their windows."""
    parts = np.lib.stride_tricks.sliding_window_view(values, size)[:: size - size // 2]
    if centred:
        parts = parts - parts.mean(axis=1, keepdims=True)
    return np.fft.rfft(parts * _taper(size), length)


def _taper(size: int) -> FloatArray:
    return np.asarray(0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(size) / size))


def _frequencies(length: int, rate: float) -> FloatArray:
    return np.asarray(np.fft.rfftfreq(length, 1.0 / rate), dtype=np.float64)


def _divisor(length: int, rate: float, size: int) -> FloatArray:
    """Squares of transforms, divided by it, are power per Hz.

    The power at a negative frequency is added to that at the positive one.
    """
    divisor = np.full(length // 2 + 1, rate * np.sum(_taper(size) ** 2))
    divisor[1 : (length + 1) // 2] /= 2.0
    return divisor
