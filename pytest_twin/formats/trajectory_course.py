"""Course of a setpoint between two points of a trajectory: line, cubic or quintic.

The columns (c,) of a course are quantities times joints: positions, velocities, efforts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.formats.ros_serialization import Floats, Integers

_CHORD = 1e-6
"""rad, m, rad/s or m/s. Curves are sampled so that straight lines between samples differ less."""
_FINEST = 1_000_000
"""ns. Samples of a curve are not closer, because few controllers run faster than 1 kHz."""
_POWERS = np.arange(6.0)


class TooManySetpointsError(ValueError):
    """The curves between points need more samples than a recording may have."""


@dataclass(frozen=True, slots=True)
class PointState:
    """One point: (c,) values, and velocity and acceleration (j,) where it has them."""

    value: Floats
    velocity: Floats | None
    acceleration: Floats | None

    def state(self, count: int) -> tuple[Floats, Floats, Floats]:
        """Position, velocity and acceleration (j,) that a following course begins with."""
        still = np.zeros(count)
        return (
            self.value[:count],
            still if self.velocity is None else self.velocity,
            still if self.acceleration is None else self.acceleration,
        )


def course(begin: PointState, end: PointState, seconds: float, count: int) -> Floats:
    """(6, c) coefficients of the course between two points."""
    coefficients = np.zeros((6, len(begin.value)))
    coefficients[0] = begin.value
    coefficients[1] = (end.value - begin.value) / seconds
    position = slice(0, count)
    if begin.velocity is None or end.velocity is None:
        return coefficients
    if not np.isfinite(end.value[position]).any():
        return coefficients
    v0, v1 = begin.velocity * seconds, end.velocity * seconds
    way = end.value[position] - begin.value[position]
    # With time relative to the segment's duration.
    if begin.acceleration is None or end.acceleration is None:
        relative = [v0, 3.0 * way - 2.0 * v0 - v1, v0 + v1 - 2.0 * way]
    else:
        a0, a1 = begin.acceleration * seconds**2, end.acceleration * seconds**2
        relative = [
            v0,
            0.5 * a0,
            10.0 * way - 6.0 * v0 - 4.0 * v1 - 1.5 * a0 + 0.5 * a1,
            -15.0 * way + 8.0 * v0 + 7.0 * v1 + 1.5 * a0 - a1,
            6.0 * way - 3.0 * (v0 + v1) - 0.5 * (a0 - a1),
        ]
    for power, one in enumerate(relative, start=1):
        coefficients[power, position] = one / seconds**power
    coefficients[:, count : 2 * count] = derivative(coefficients[:, position])
    return coefficients


def constant(value: Floats) -> Floats:
    """(6, c) coefficients of a setpoint that stays."""
    coefficients = np.zeros((6, len(value)))
    coefficients[0] = value
    return coefficients


def derivative(coefficients: Floats) -> Floats:
    """(6, c) coefficients of the derivative."""
    derivatives = np.zeros_like(coefficients)
    derivatives[:-1] = coefficients[1:] * _POWERS[1:, None]
    return derivatives


def value_at(coefficients: Floats, since: float) -> Floats:
    """(c,) value of polynomials at one time, s."""
    value: Floats = np.asarray(since**_POWERS @ coefficients)
    return value


def times_inside(coefficients: Floats, length: int, count: int, most_values: int) -> Integers:
    """(k,) times within a course of ``length`` ns between which straight lines follow it.

    Raises:
        TooManySetpointsError: more values than ``most_values``.
    """
    if not coefficients[2:].any():
        return np.zeros(0, dtype=np.int64)
    bend = derivative(derivative(coefficients[:, : 2 * count]))
    at = np.linspace(0.0, length * 1e-9, 9)
    curvature = np.nan_to_num(np.polynomial.polynomial.polyval(at, bend))
    largest = float(np.abs(curvature).max())
    needed = length * 1e-9 * np.sqrt(largest / (8.0 * _CHORD))
    parts = int(min(np.ceil(needed), -(-length // _FINEST)))
    if parts * 3 * count > most_values:
        raise TooManySetpointsError
    fraction = np.arange(1, parts) / max(parts, 1)
    return np.rint(length * fraction).astype(np.int64)
