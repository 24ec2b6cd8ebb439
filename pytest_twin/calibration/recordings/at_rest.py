"""Find the stamps at which a robot stood still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray

WINDOW_S = 0.1
"""Time before and after a stamp during which the robot must stand still. Exposure, transport and
the clocks of two drivers differ by up to some tens of milliseconds."""

STILL_RAD, STILL_M = 2e-3, 5e-4
"""Largest motion within the window of a robot that stands still. One count of an encoder with 4096
counts per revolution is 1.5 mrad."""


@dataclass(frozen=True)
class RestInterval:
    """Stamps at which the robot stood still in one pose.

    Attributes:
        rows: indices of the stamps, ascending.
    """

    rows: tuple[int, ...]

    @property
    def middle(self) -> int:
        """The stamp in the middle."""
        return self.rows[len(self.rows) // 2]


@dataclass(frozen=True)
class MotionInterval:
    """Consecutive stamps at which the robot was not still.

    Attributes:
        rows: indices of the stamps, ascending.
        why: reason, as text.
    """

    rows: tuple[int, ...]
    why: str


def rest_and_motion(
    stamps: FloatArray,
    time: FloatArray,
    values: FloatArray,
    still: FloatArray,
    names: Sequence[str],
    units: Sequence[str],
) -> tuple[list[RestInterval], list[MotionInterval]]:
    """Return the stamps at rest, grouped by pose of the robot, and the stamps in motion.

    Args:
        stamps: (m,) stamps of images or poses, s, ascending.
        time: (n,) stamps of the robot's states on the same clock, s, ascending.
        values: (n, k) positions of its joints, or of its flange.
        still: (k,) largest motion within the window of a robot that stands still.
        names, units: names and units of the columns.
    """
    found: list[RestInterval] = []
    moving: list[MotionInterval] = []
    before: tuple[bool, FloatArray] | None = None
    for row, stamp in enumerate(stamps):
        reason, place = _positions_at(float(stamp), time, values, still, names, units)
        same = before is not None and (np.abs(place - before[1]) <= still).all()
        if reason:
            if before is None or before[0]:
                moving.append(MotionInterval((row,), reason))
            else:
                moving[-1] = MotionInterval((*moving[-1].rows, row), moving[-1].why)
        elif before is not None and before[0] and same:
            found[-1] = RestInterval((*found[-1].rows, row))
        else:
            found.append(RestInterval((row,)))
        before = (not reason, place)
    return found, moving


def _positions_at(
    stamp: float,
    time: FloatArray,
    values: FloatArray,
    still: FloatArray,
    names: Sequence[str],
    units: Sequence[str],
) -> tuple[str, FloatArray]:
    """Return the reason why a stamp is unusable (else empty), and the robot's positions."""
    place = interpolate(np.array([stamp]), time, values)[0]
    if stamp < time[0] or stamp > time[-1]:
        return "no state of the robot at its stamp", place
    low, high = np.searchsorted(time, [stamp - WINDOW_S, stamp + WINDOW_S])
    at = int(np.searchsorted(time, stamp))
    nearest, previous = time[min(at, len(time) - 1)], time[max(at - 1, 0)]
    if nearest - previous > 2.0 * WINDOW_S:
        return (
            f"no state of the robot within {1e3 * WINDOW_S:.0f} ms of its stamp: the states have a "
            f"gap of {nearest - previous:.2f} s"
        ), place
    around = np.vstack([values[low:high], place])
    motion = np.ptp(around, axis=0)
    worst = int(np.argmax(motion / still))
    if motion[worst] <= still[worst]:
        return "", place
    unit = "mrad" if units[worst] == "rad" else "mm"
    return (
        f"in motion: {names[worst]} moves by {1e3 * motion[worst]:.3g} {unit} within "
        f"{1e3 * WINDOW_S:.0f} ms of its stamp ({1e3 * still[worst]:.3g} {unit} count as still)"
    ), place


def interpolate(stamps: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    """(m, k) values at stamps, interpolated linearly; constant beyond the ends."""
    return np.stack([np.interp(stamps, time, column) for column in values.T], axis=1)
