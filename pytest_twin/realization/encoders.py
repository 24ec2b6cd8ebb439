"""Between what a robot's encoders read and what its model means.

``model = sign * scale * read + offset``. Offsets are of positions alone; velocities follow sign and
scale, efforts the sign. Position and velocity commands are in the encoders' terms too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.realization.model import Realization
from pytest_twin.twin import JointCalibration

_IDENTITY = JointCalibration()


def calibration_of(realization: Realization) -> Mapping[str, JointCalibration]:
    """Joint -> how its encoder relates to the model; empty where the twin does not say."""
    twin = realization.twin
    return {} if twin is None or twin.calibration is None else twin.calibration.joints


@dataclass(frozen=True, slots=True)
class Encoders:
    """The encoders of some joints; arrays have a column for each.

    Attributes:
        sign: (j,) 1.0 or -1.0.
        offset: (j,) rad or m.
        scale: (j,) true turn over the turn that is read.
    """

    sign: FloatArray
    offset: FloatArray
    scale: FloatArray

    @classmethod
    def of(cls, calibration: Mapping[str, JointCalibration], joints: Sequence[str]) -> Self:
        """Those of ``joints``; a joint without a calibration has the identity."""
        items = [calibration.get(joint, _IDENTITY) for joint in joints]
        table = np.array([(i.sign, i.offset, i.scale) for i in items]).reshape(-1, 3)
        return cls(table[:, 0], table[:, 1], table[:, 2])

    @property
    def slope(self) -> FloatArray:
        """(j,) derivative of the model's position by the reading."""
        slope: FloatArray = self.sign * self.scale
        return slope

    def model_position(self, read: FloatArray) -> FloatArray:
        """Positions (..., j) as the model has them, rad or m."""
        position: FloatArray = self.slope * read + self.offset
        return position

    def read_position(self, model: FloatArray) -> FloatArray:
        """Positions (..., j) as the encoders read them, rad or m."""
        position: FloatArray = (model - self.offset) / self.slope
        return position

    def model_velocity(self, read: FloatArray) -> FloatArray:
        """Velocities (..., j) as the model has them, rad/s or m/s."""
        velocity: FloatArray = self.slope * read
        return velocity

    def read_velocity(self, model: FloatArray) -> FloatArray:
        """Velocities (..., j) as the encoders read them, rad/s or m/s."""
        velocity: FloatArray = model / self.slope
        return velocity

    def signed(self, values: FloatArray) -> FloatArray:
        """Efforts (..., j), from either side to the other."""
        signed: FloatArray = self.sign * values
        return signed

    def model_command(self, sent: FloatArray, modes: Sequence[str]) -> FloatArray:
        """Commands (..., j) as the model has them, each column of its own mode: ``position``,
        ``velocity`` or ``effort``."""
        positions = np.array([mode == "position" for mode in modes])
        efforts = np.array([mode == "effort" for mode in modes])
        slope = np.where(efforts, self.sign, self.slope)
        command: FloatArray = slope * sent + np.where(positions, self.offset, 0.0)
        return command
