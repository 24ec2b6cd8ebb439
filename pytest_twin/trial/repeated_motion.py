"""Find one motion in two recordings, such as a converted, renamed or shortened copy.

Digests find copies of a file. A copy in another format, or cut to a part, has another digest and
the same measured positions.
"""

from __future__ import annotations

import numpy as np

from pytest_twin.trial.trial import Trial

_WINDOW = 16
"""Number of successive samples that are compared together."""
_DISTINCT = 8
"""Fewest different samples in a window. Encoders at rest read the same in every recording."""
_MOST_WINDOWS = 64
"""Largest number of windows that are looked for."""
_SAME = 2e-6
"""Largest difference of equal positions, rad or m: text formats keep six digits."""
_SHARE = 0.5
"""Fraction of the windows that the other trial contains, above which both show one motion."""


def repeats_motion(trial: Trial, other: Trial) -> bool:
    """Whether most of a trial's measured motion is in the other trial, sample by sample."""
    joints = [name for name in trial.joints if name in other.joints]
    if not joints:
        return False
    mine = trial.position[:, [trial.joints.index(name) for name in joints]]
    theirs = other.position[:, [other.joints.index(name) for name in joints]]
    starts = [
        start
        for start in range(0, len(mine) - _WINDOW + 1, _WINDOW)
        if len(np.unique(mine[start : start + _WINDOW], axis=0)) >= _DISTINCT
    ]
    if not starts:
        return False
    chosen = np.linspace(0, len(starts) - 1, min(_MOST_WINDOWS, len(starts))).astype(int)
    windows = [mine[starts[at] : starts[at] + _WINDOW] for at in chosen]
    there = sum(_contains(theirs, window) for window in windows)
    return there > _SHARE * len(windows)


def _contains(positions: np.ndarray, window: np.ndarray) -> bool:
    """Whether the rows of a window follow each other somewhere in the positions."""
    last = len(positions) - len(window) + 1
    if last < 1:
        return False
    same = np.abs(positions[:last] - window[0]).max(axis=1) <= _SAME
    return any(
        np.abs(positions[start : start + len(window)] - window).max() <= _SAME
        for start in np.flatnonzero(same)
    )
