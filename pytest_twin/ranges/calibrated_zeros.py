"""Uncertainty of calibrated joint zeros as coordinates of a randomization."""

from __future__ import annotations

import numpy as np

from pytest_twin.budget.propagate import root_of
from pytest_twin.dependency import Structure
from pytest_twin.effects.sensing import EncoderBias
from pytest_twin.ranges.distribution import Coordinate
from pytest_twin.ranges.identified_coordinates import RecordCoordinates
from pytest_twin.twin import CalibrationEntry

_PREFIX = "joint_zeros."


def zeros_of(entry: CalibrationEntry, structure: Structure, taken: set[str]) -> RecordCoordinates:
    """Return deviations of encoder zeros; those in ``taken`` belong to a later record.

    Raises:
        FormatError: the matrix is no covariance.
    """
    record = entry.record
    names = record.covariance_names
    matrix = np.reshape(record.covariance, (len(names),) * 2)
    root_of(matrix, record.path)
    found = RecordCoordinates(record.id, [], np.zeros((0, 0)))
    kept = []
    for at, name in enumerate(names):
        joint = name.removeprefix(_PREFIX)
        if not name.startswith(_PREFIX):
            found.left_out.append(
                f"{name}: moves no joint; pytest-twin budget carries it to a frame"
            )
        elif "joint_zeros" not in entry.use or joint not in structure.joint_type:
            found.left_out.append(f"{name}: the twin does not use it")
        elif joint not in taken:
            kept.append(at)
            found.coordinates.append(encoder_zero(joint, structure))
    found.covariance = matrix[np.ix_(kept, kept)]
    return found


def encoder_zero(joint: str, structure: Structure) -> Coordinate:
    """Return the coordinate of an encoder's deviation from the calibrated zero."""
    unit = "m" if structure.joint_type[joint] == "slide" else "rad"
    return Coordinate(
        f"{joint}.{EncoderBias.id}", unit, 0.0, 0.0, joint=joint, effect=EncoderBias.id,
        parameter="bias", is_deviation=True,
    )  # fmt: skip
