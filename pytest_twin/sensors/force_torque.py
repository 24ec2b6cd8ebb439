"""A force-torque sensor: bias, scale, cross-axis coupling, frame, filter and saturation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from pytest_twin.arrays import FloatArray

AXES = ("fx", "fy", "fz", "tx", "ty", "tz")
_AT_LIMIT = 3
"""Samples in a row at the greatest reading from which on it is a limit."""


@dataclass(frozen=True)
class ForceTorqueSensor:
    """``reading = clip(lowpass(coupling wrench) + bias)``.

    The 6 by 6 coupling has the scales on its diagonal. It holds the rotation and offset of the
    sensor's frame too: no wrench tells a turned frame from cross-axis coupling (Liu, Tzo, 2002).

    Attributes:
        bias: (6,) N, N*m.
        coupling: (6, 6) reading by true wrench, force before torque.
        time_constant: of the first-order low-pass, s; 0 for none.
        limit: (6,) greatest amount that is read, N, N*m; infinite for none.
    """

    bias: FloatArray
    coupling: FloatArray
    time_constant: float
    limit: FloatArray

    def measured(self, wrench: FloatArray, period: float) -> FloatArray:
        """(n, 6) readings of (n, 6) true wrenches in the sensor's frame, ``period`` s apart."""
        passed = low_passed(wrench, self.time_constant, period) @ self.coupling.T
        return np.asarray(np.clip(passed + self.bias, -self.limit, self.limit))


def low_passed(values: FloatArray, time_constant: float, period: float) -> FloatArray:
    """(n, k) after a first-order low-pass at rest at the first sample, held between samples."""
    if time_constant <= 0.0:
        return values
    pole = float(np.exp(-period / time_constant))
    start = pole * values[:1]
    found, _ = lfilter([1.0 - pole], [1.0, -pole], values, axis=0, zi=start)
    return np.asarray(found)


def limits_of(reading: FloatArray) -> FloatArray:
    """(k,) amounts at which channels stand again and again, infinite where they do not."""
    found = np.full(reading.shape[1], np.inf)
    for channel, values in enumerate(np.abs(reading).T):
        most = values.max(initial=0.0)
        stands = values >= most * (1.0 - 1e-9)
        runs = np.convolve(stands, np.ones(_AT_LIMIT), mode="valid")
        if most > 0.0 and (runs >= _AT_LIMIT).any() and np.ptp(values) > 1e-6 * most:
            found[channel] = most
    return found
