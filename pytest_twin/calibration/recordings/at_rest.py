"""Which of some stamps fall into moments in which a robot stands still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray

WINDOW_S = 0.1
"""The robot must stand still this long before and after a stamp: exposure, transport and the stamps
of two drivers differ by up to some tens of milliseconds."""

STILL_RAD, STILL_M = 2e-3, 5e-4
"""Motion within the window up to which the robot counts as still: one count of an encoder with
4096 counts a turn is 1.5 mrad."""


@dataclass(frozen=True)
class Rest:
    """Stamps taken while the robot stood in one place.

    Attributes:
        rows: which stamps, ascending.
    """

    rows: tuple[int, ...]

    @property
    def middle(self) -> int:
        """The stamp in the middle."""
        return self.rows[len(self.rows) // 2]


@dataclass(frozen=True)
class Moving:
    """Consecutive stamps at which the robot was not still.

    Attributes:
        rows: which stamps, ascending.
        why: in words.
    """

    rows: tuple[int, ...]
    why: str


def rests(
    stamps: FloatArray,
    time: FloatArray,
    values: FloatArray,
    still: FloatArray,
    names: Sequence[str],
    units: Sequence[str],
) -> tuple[list[Rest], list[Moving]]:
    """Stamps at rest, by the place where the robot stood, and those in motion.

    Args:
        stamps: (m,) s, ascending, of images or poses.
        time: (n,) s, ascending, of the robot's states on the same clock.
        values: (n, k) positions of its joints, or of its flange.
        still: (k,) motion of each within the window that counts as standing still.
        names, units: of the columns.
    """
    found: list[Rest] = []
    moving: list[Moving] = []
    before: tuple[bool, FloatArray] | None = None
    for row, stamp in enumerate(stamps):
        reason, place = _at(float(stamp), time, values, still, names, units)
        same = before is not None and (np.abs(place - before[1]) <= still).all()
        if reason:
            if before is None or before[0]:
                moving.append(Moving((row,), reason))
            else:
                moving[-1] = Moving((*moving[-1].rows, row), moving[-1].why)
        elif before is not None and before[0] and same:
            found[-1] = Rest((*found[-1].rows, row))
        else:
            found.append(Rest((row,)))
        before = (not reason, place)
    return found, moving


def _at(
    stamp: float,
    time: FloatArray,
    values: FloatArray,
    still: FloatArray,
    names: Sequence[str],
    units: Sequence[str],
) -> tuple[str, FloatArray]:
    """Why a stamp is not usable, empty where it is; and where the robot was."""
    place = interpolated(np.array([stamp]), time, values)[0]
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


def interpolated(stamps: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    """(m, k) values at some stamps, linear between the states; the ends are held."""
    return np.stack([np.interp(stamps, time, column) for column in values.T], axis=1)
