"""Find one measurement in two recordings, such as a converted, renamed or shortened copy.

Digests find copies of a file. A copy in another format, or cut to a part, has another digest and
the same measured positions and efforts.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray

_WINDOW = 16
"""Number of successive samples that are compared together."""
_DISTINCT = 8
"""Fewest different samples in a window. Encoders at rest read the same in every recording."""
_MOST_WINDOWS = 64
"""Number of windows that are looked for, up to twice as many."""
_FIRST_WINDOWS = 8
"""Number of windows that are looked for first: of different motions, none of them is in both."""
_SAME = 6e-7
"""Largest difference of equal positions, rad or m: half of the sixth decimal of text formats, and
the rounding of single precision. A precise axis repeats a motion to 1e-6 m and more (EMPS: of its
two recordings 1 % of the windows agree to 5e-7 m, 32 % to 2e-6 m)."""
_SAME_EFFORT = 1e-4
"""Largest difference of equal efforts, relative to the largest effort: rounded decimals, and torque
constants that are applied before or after rounding. Sensors have ten times this noise."""
_SHARE = 0.5
"""Fraction of the windows that the other trial contains, above which both show one motion."""
_OVERLAP = 0.15
"""Fraction of the windows above which two recordings have a part in common. Motions that an axis
repeats have up to 3 % of them in common (EMPS), and those that a coarse encoder reads up to 4 %
(XL330, steps of 1.5e-3 rad). A part of an eighth of a recording contains a first window."""
_TURN = 2.0 * np.pi
"""One turn, rad: unwrapped angles start within the first one, also in a recording that is cut."""


class Measured(Protocol):
    """A recording with the measured positions of its joints."""

    @property
    def path(self) -> Path:
        """Its file."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Names in the model."""

    @property
    def position(self) -> FloatArray:
        """(n, j) rad or m."""

    @property
    def effort(self) -> FloatArray | None:
        """(n, j) N*m or N, NaN where it is unknown; None without any."""


_Recording = TypeVar("_Recording", bound=Measured)


def without_repeated(
    fit: Sequence[_Recording], held_out: Sequence[_Recording], notes: list[str]
) -> tuple[list[_Recording], list[_Recording]]:
    """Recordings to fit and held-out ones, without those that share a measured motion.

    A copy would count as a second proof, or test a fit with the data that it was made from. Of two
    recordings with one motion the one to fit is kept, else the longer one, else the first.

    Args:
        notes: list to which a line for each removed recording is added.
    """
    kept: list[_Recording] = []
    for recordings in (fit, held_out):
        for one in sorted(recordings, key=lambda one: -len(one.position)):
            same = next((other for other in kept if _shows_motion_of(one, other)), None)
            if same is None:
                kept.append(one)
            else:
                notes.append(
                    f"left out: {one.path}: its measured motion is that of {same.path.name}"
                )
    left = set(map(id, kept))
    of_fit, of_test = ([one for one in some if id(one) in left] for some in (fit, held_out))
    return of_fit, of_test


def overlaps(one: Measured, other: Measured) -> bool:
    """Whether two recordings have a part of their measurements in common."""
    return max(_share(one, other), _share(other, one)) > _OVERLAP


def repeats_motion(trial: Measured, other: Measured) -> bool:
    """Whether most of a trial's measurements are in the other trial, sample by sample."""
    return _share(trial, other) > _SHARE


def _shows_motion_of(one: Measured, other: Measured) -> bool:
    return repeats_motion(one, other) or repeats_motion(other, one)


def _share(trial: Measured, other: Measured) -> float:
    """Fraction of a trial's windows that the other trial contains; 0 if none of the first ones.

    A precise machine repeats a motion, but not the noise of its efforts: these must agree too,
    where both recordings have them.
    """
    joints = [name for name in trial.joints if name in other.joints]
    if not joints:
        return 0.0
    mine, theirs = (
        one.position[:, [one.joints.index(name) for name in joints]] for one in (trial, other)
    )
    efforts = _efforts(trial, other, joints)
    starts = _windows(mine)

    def is_distinct(start: int) -> bool:
        return len(np.unique(mine[start : start + _WINDOW], axis=0)) >= _DISTINCT

    def contains(start: int) -> bool:
        rows = slice(start, start + _WINDOW)
        return _contains(theirs, efforts[1], mine[rows], efforts[0][rows])

    first = starts[:: max(1, len(starts) // _FIRST_WINDOWS)]
    if not any(is_distinct(start) and contains(start) for start in first):
        return 0.0
    distinct = [start for start in starts if is_distinct(start)]
    return sum(map(contains, distinct)) / len(distinct)


def _efforts(
    trial: Measured, other: Measured, joints: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """(n, k) efforts that both recordings have throughout, relative to the largest difference."""
    if trial.effort is None or other.effort is None:
        return np.empty((len(trial.position), 0)), np.empty((len(other.position), 0))
    mine, theirs = (
        effort[:, [one.joints.index(name) for name in joints]]
        for one, effort in ((trial, trial.effort), (other, other.effort))
    )
    known = np.isfinite(mine).all(axis=0) & np.isfinite(theirs).all(axis=0)
    mine, theirs = mine[:, known], theirs[:, known]
    largest = np.maximum(np.abs(mine).max(axis=0), np.abs(theirs).max(axis=0))
    scale = _SAME_EFFORT * np.where(largest > 0.0, largest, 1.0)
    return mine / scale, theirs / scale


def _windows(positions: FloatArray) -> list[int]:
    """First rows of windows in which a robot moves, evenly spread."""
    moves = (np.diff(positions, axis=0, prepend=positions[:1]) != 0.0).any(axis=1)
    starts = np.arange(0, len(positions) - _WINDOW + 1, _WINDOW)
    count = np.concatenate([[0], np.cumsum(moves)])
    starts = starts[count[starts + _WINDOW] - count[starts] >= _DISTINCT - 1]
    return list(starts[:: max(1, len(starts) // _MOST_WINDOWS)].tolist())


def _contains(
    positions: FloatArray, efforts: FloatArray, window: FloatArray, window_efforts: FloatArray
) -> bool:
    """Whether the rows of a window follow each other somewhere in positions and efforts."""
    last = len(positions) - len(window) + 1
    if last < 1:
        return False
    busiest = int(np.argmax(np.ptp(window, axis=0)))
    starts = np.flatnonzero(_is_same(positions[:last, busiest], window[0, busiest]))
    for row in range(len(window)):
        starts = starts[_is_same(positions[starts + row], window[row]).all(axis=1)]
        agrees = np.abs(efforts[starts + row] - window_efforts[row]) <= 1.0
        starts = starts[agrees.all(axis=1)]
        if not len(starts):
            return False
    return True


def _is_same(positions: FloatArray, wanted: FloatArray) -> NDArray[np.bool_]:
    """Whether positions are equal, up to whole turns."""
    turned = np.remainder(positions - wanted + 0.5 * _TURN, _TURN) - 0.5 * _TURN
    return np.asarray(np.abs(turned) <= _SAME)
