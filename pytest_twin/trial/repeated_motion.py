"""Find one motion in two recordings, such as a converted, renamed or shortened copy.

Digests find copies of a file. A copy in another format, or cut to a part, has another digest and
the same measured positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

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
_SHARE = 0.5
"""Fraction of the windows that the other trial contains, above which both show one motion."""


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
            same = next((other for other in kept if _share_motion(one, other)), None)
            if same is None:
                kept.append(one)
            else:
                notes.append(
                    f"left out: {one.path}: its measured motion is that of {same.path.name}"
                )
    left = set(map(id, kept))
    of_fit, of_test = ([one for one in some if id(one) in left] for some in (fit, held_out))
    return of_fit, of_test


def _share_motion(one: Measured, other: Measured) -> bool:
    return repeats_motion(one, other) or repeats_motion(other, one)


def repeats_motion(trial: Measured, other: Measured) -> bool:
    """Whether most of a trial's measured motion is in the other trial, sample by sample."""
    joints = [name for name in trial.joints if name in other.joints]
    if not joints:
        return False
    mine = trial.position[:, [trial.joints.index(name) for name in joints]]
    theirs = other.position[:, [other.joints.index(name) for name in joints]]
    windows = _windows(mine)
    first = windows[:: max(1, len(windows) // _FIRST_WINDOWS)]
    if not any(_contains(theirs, window) for window in first):
        return False
    there = sum(_contains(theirs, window) for window in windows)
    return there > _SHARE * len(windows)


def _windows(positions: FloatArray) -> list[FloatArray]:
    """Windows in which a robot moves, evenly spread."""
    moves = (np.diff(positions, axis=0, prepend=positions[:1]) != 0.0).any(axis=1)
    starts = np.arange(0, len(positions) - _WINDOW + 1, _WINDOW)
    count = np.concatenate([[0], np.cumsum(moves)])
    starts = starts[count[starts + _WINDOW] - count[starts] >= _DISTINCT - 1]
    chosen = starts[:: max(1, len(starts) // _MOST_WINDOWS)]
    windows = (positions[start : start + _WINDOW] for start in chosen)
    return [window for window in windows if len(np.unique(window, axis=0)) >= _DISTINCT]


def _contains(positions: FloatArray, window: FloatArray) -> bool:
    """Whether the rows of a window follow each other somewhere in the positions."""
    last = len(positions) - len(window) + 1
    if last < 1:
        return False
    busiest = int(np.argmax(np.ptp(window, axis=0)))
    starts = np.flatnonzero(np.abs(positions[:last, busiest] - window[0, busiest]) <= _SAME)
    for row in range(len(window)):
        starts = starts[(np.abs(positions[starts + row] - window[row]) <= _SAME).all(axis=1)]
        if not len(starts):
            return False
    return True
