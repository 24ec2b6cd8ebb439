"""Joint torque sensor between gear and link, so friction of the gear is not measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.sensors.force_torque import low_passed


@dataclass(frozen=True)
class JointTorqueSensor:
    """Joint torque sensor with ``reading = clip(scale lowpass(load) + bias)``.

    The load is the effort that the links beyond the joint require. Inertia and friction of motor
    and gear are on the other side of the sensor (Albu-Schäffer, Ott, Hirzinger, 2007).

    Attributes:
        bias: bias, N*m; N for a prismatic joint.
        time_constant: time constant of the first-order low-pass, s; 0 for none.
        limit: largest magnitude of a reading, N*m or N; infinite for none.
    """

    bias: float
    scale: float
    time_constant: float
    limit: float

    def measured(self, load: FloatArray, period: float) -> FloatArray:
        """(n, 1) readings of (n, 1) true loads, ``period`` s apart."""
        passed = self.scale * low_passed(load, self.time_constant, period)
        return np.asarray(np.clip(passed + self.bias, -self.limit, self.limit))
