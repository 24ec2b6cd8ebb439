"""Inertial measurement unit with bias, scale, misalignment, and noise by Allan deviation."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import TwinError

AXES = ("gx", "gy", "gz", "ax", "ay", "az")
_FLAT = 0.664
"""Ratio of the Allan deviation of flicker noise to its bias instability, sqrt(2 ln 2 / pi) (IEEE
952)."""


@dataclass(frozen=True)
class ImuSensor:
    """IMU with ``reading = matrix true + bias`` for gyroscope and accelerometer.

    A matrix has the scales on its diagonal and the misalignment off the diagonal.

    Attributes:
        gyroscope, accelerometer: (3, 3) matrices.
        gyroscope_bias, accelerometer_bias: (3,) biases, rad/s and m/s^2.
    """

    gyroscope: FloatArray
    gyroscope_bias: FloatArray
    accelerometer: FloatArray
    accelerometer_bias: FloatArray

    def measured(self, true: FloatArray) -> FloatArray:
        """(n, 6) readings of (n, 6) true angular velocity and specific force, in sensor axes."""
        turning = true[:, :3] @ self.gyroscope.T + self.gyroscope_bias
        pushing = true[:, 3:] @ self.accelerometer.T + self.accelerometer_bias
        return np.hstack([turning, pushing])


@dataclass(frozen=True)
class ChannelNoise:
    """Noise of one channel at rest.

    Attributes:
        density: density of white noise, unit / sqrt(Hz): the Allan deviation at 1 s on the slope of
            -1/2.
        density_std: standard deviation of the density.
        instability: bias instability, in the reading's unit: the smallest Allan deviation over
            0.664; None if the deviation still decreases at the longest time, because the recording
            is too short.
    """

    density: float
    density_std: float
    instability: float | None


def noise_of(still: FloatArray, rate: float) -> list[ChannelNoise]:
    """Return the noise of (n, k) readings at rest, by overlapping Allan deviation.

    Args:
        still: (n, k) readings at rest.
        rate: sampling rate, Hz.

    Raises:
        TwinError: allantools is not installed.
    """
    try:
        allan: Any = importlib.import_module("allantools")
    except ImportError:
        raise TwinError(
            "allantools is not installed",
            where="noise of an IMU",
            expected="pip install 'pytest-twin[sensors]'",
        ) from None
    longest = len(still) / rate
    times = np.geomspace(1.0 / rate, longest / 5.0, 40)
    found = []
    for values in still.T:
        taus, deviations, _, _ = allan.oadev(values, rate=rate, data_type="freq", taus=times)
        # The longest time is a tenth of the record's length; beyond it, too few pairs are averaged.
        short = taus <= max(taus[0], longest / 100.0)
        densities = deviations[short] * np.sqrt(taus[short])
        density = float(np.median(densities))
        # The median is about as accurate as the estimate at the middle of these times.
        pairs = longest / float(np.sqrt(taus[0] * taus[short][-1]))
        least = int(np.argmin(deviations))
        flat = least < len(taus) - 2 and deviations[-1] > 1.05 * deviations[least]
        found.append(
            ChannelNoise(
                density,
                density / float(np.sqrt(2.0 * pairs)),
                float(deviations[least]) / _FLAT if flat else None,
            )
        )
    return found
