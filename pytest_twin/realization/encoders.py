"""Conversion between encoder readings and the joint coordinates of the model.

``model = sign * scale * read + offset`` holds for positions. Velocities use sign and scale, efforts
the sign. Position and velocity commands are converted in the same way.
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
    """Joint -> sign, scale and offset of its encoder; empty without a calibration."""
    twin = realization.twin
    return {} if twin is None or twin.calibration is None else twin.calibration.joints


@dataclass(frozen=True, slots=True)
class Encoders:
    """Encoders of several joints; arrays have one column per joint.

    Attributes:
        sign: (j,) 1.0 or -1.0.
        offset: (j,) rad or m.
        scale: (j,) ratio of the true to the measured displacement.
    """

    sign: FloatArray
    offset: FloatArray
    scale: FloatArray

    @classmethod
    def of(cls, calibration: Mapping[str, JointCalibration], joints: Sequence[str]) -> Self:
        """Encoders of ``joints``; without calibration, sign and scale are 1 and the offset 0."""
        items = [calibration.get(joint, _IDENTITY) for joint in joints]
        table = np.array([(i.sign, i.offset, i.scale) for i in items]).reshape(-1, 3)
        return cls(table[:, 0], table[:, 1], table[:, 2])

    @property
    def slope(self) -> FloatArray:
        """(j,) derivative of the model's position with respect to the reading."""
        slope: FloatArray = self.sign * self.scale
        return slope

    def model_position(self, read: FloatArray) -> FloatArray:
        """Convert readings (..., j) to positions of the model, rad or m."""
        position: FloatArray = self.slope * read + self.offset
        return position

    def read_position(self, model: FloatArray) -> FloatArray:
        """Convert positions of the model (..., j) to readings, rad or m."""
        position: FloatArray = (model - self.offset) / self.slope
        return position

    def model_velocity(self, read: FloatArray) -> FloatArray:
        """Convert measured velocities (..., j) to those of the model, rad/s or m/s."""
        velocity: FloatArray = self.slope * read
        return velocity

    def read_velocity(self, model: FloatArray) -> FloatArray:
        """Convert velocities of the model (..., j) to measured ones, rad/s or m/s."""
        velocity: FloatArray = model / self.slope
        return velocity

    def signed(self, values: FloatArray) -> FloatArray:
        """Convert efforts (..., j) between encoder and model, in either direction; N*m or N."""
        signed: FloatArray = self.sign * values
        return signed

    def model_command(self, sent: FloatArray, modes: Sequence[str]) -> FloatArray:
        """Convert commands (..., j) to those of the model.

        Args:
            sent: (..., j) recorded commands, rad, rad/s or N*m (m, m/s or N at a slide).
            modes: ``position``, ``velocity`` or ``effort`` for each column.
        """
        positions = np.array([mode == "position" for mode in modes])
        efforts = np.array([mode == "effort" for mode in modes])
        slope = np.where(efforts, self.sign, self.slope)
        command: FloatArray = slope * sent + np.where(positions, self.offset, 0.0)
        return command
