"""Force-torque sensor with bias, scale, cross-axis coupling, frame, filter and saturation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from pytest_twin.arrays import FloatArray

AXES = ("fx", "fy", "fz", "tx", "ty", "tz")
_AT_LIMIT = 3
"""Number of consecutive samples at the largest reading above which it is a limit."""


@dataclass(frozen=True)
class ForceTorqueSensor:
    """Force-torque sensor with ``reading = clip(lowpass(coupling wrench) + bias)``.

    The 6 by 6 coupling has the scales on its diagonal. It includes the rotation and offset of the
    sensor's frame, because no wrench distinguishes a rotated frame from cross-axis coupling (Liu,
    Tzo, 2002).

    Attributes:
        bias: (6,) bias, N and N*m.
        coupling: (6, 6) matrix from true wrench to reading, force before torque.
        time_constant: time constant of the first-order low-pass, s; 0 for none.
        limit: (6,) largest magnitude of a reading, N and N*m; infinite for none.
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
    """(n, k) output of a first-order low-pass, in steady state at the first sample."""
    if time_constant <= 0.0:
        return values
    pole = float(np.exp(-period / time_constant))
    start = pole * values[:1]
    found, _ = lfilter([1.0 - pole], [1.0, -pole], values, axis=0, zi=start)
    return np.asarray(found)


def limits_of(reading: FloatArray) -> FloatArray:
    """(k,) magnitudes at which channels saturate repeatedly; infinite if they do not."""
    found = np.full(reading.shape[1], np.inf)
    for channel, values in enumerate(np.abs(reading).T):
        most = values.max(initial=0.0)
        stands = values >= most * (1.0 - 1e-9)
        runs = np.convolve(stands, np.ones(_AT_LIMIT), mode="valid")
        if most > 0.0 and (runs >= _AT_LIMIT).any() and np.ptp(values) > 1e-6 * most:
            found[channel] = most
    return found
