"""Power spectral density of a signal by Welch's method."""

from __future__ import annotations

import numpy as np

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
    taper = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(size) / size)
    parts = np.lib.stride_tricks.sliding_window_view(values, size)[:: size - size // 2]
    if centred:
        parts = parts - parts.mean(axis=1, keepdims=True)
    power: FloatArray = np.mean(np.abs(np.fft.rfft(parts * taper, length)) ** 2, axis=0)
    power /= rate * np.sum(taper**2)
    # The power at a negative frequency is added to that at the positive one.
    power[1 : (length + 1) // 2] *= 2.0
    return np.asarray(np.fft.rfftfreq(length, 1.0 / rate), dtype=np.float64), power
