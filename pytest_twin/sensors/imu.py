"""An inertial measurement unit: bias, scale, misalignment, and noise by Allan deviation."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import TwinError

AXES = ("gx", "gy", "gz", "ax", "ay", "az")
_FLAT = 0.664
"""Allan deviation of flicker noise over its bias instability, sqrt(2 ln 2 / pi) (IEEE 952)."""


@dataclass(frozen=True)
class ImuSensor:
    """``reading = matrix true + bias``, for the gyroscope and for the accelerometer.

    A matrix has the scales on its diagonal and the misalignment beside it.

    Attributes:
        gyroscope, accelerometer: (3, 3).
        gyroscope_bias, accelerometer_bias: (3,) rad/s, m/s^2.
    """

    gyroscope: FloatArray
    gyroscope_bias: FloatArray
    accelerometer: FloatArray
    accelerometer_bias: FloatArray

    def measured(self, true: FloatArray) -> FloatArray:
        """(n, 6) readings of (n, 6) true angular velocity and specific force, sensor's axes."""
        turning = true[:, :3] @ self.gyroscope.T + self.gyroscope_bias
        pushing = true[:, 3:] @ self.accelerometer.T + self.accelerometer_bias
        return np.hstack([turning, pushing])


@dataclass(frozen=True)
class Noise:
    """Noise of one channel at rest.

    Attributes:
        density: white noise, unit / sqrt(Hz): the Allan deviation at 1 s on the slope of -1/2.
        density_std: its standard deviation.
        instability: bias instability, unit: the least Allan deviation over 0.664; None where the
            deviation still falls at the longest time, so that the recording was too short.
    """

    density: float
    density_std: float
    instability: float | None


def noise_of(still: FloatArray, rate: float) -> list[Noise]:
    """Noise of (n, k) readings of a sensor at rest, by overlapping Allan deviation.

    Args:
        still: readings while nothing moves.
        rate: samples per s.

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
        # A tenth of the record's length at most: beyond, few pairs are averaged.
        short = taus <= max(taus[0], longest / 100.0)
        densities = deviations[short] * np.sqrt(taus[short])
        density = float(np.median(densities))
        pairs = longest / float(taus[short][-1])
        least = int(np.argmin(deviations))
        flat = least < len(taus) - 2 and deviations[-1] > 1.05 * deviations[least]
        found.append(
            Noise(
                density,
                density / float(np.sqrt(2.0 * pairs)),
                float(deviations[least]) / _FLAT if flat else None,
            )
        )
    return found
