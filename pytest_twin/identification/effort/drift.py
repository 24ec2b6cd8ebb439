"""Detect friction and constant effort that change over a recording, as in a gear that warms up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.identification.effort.input_mistakes import InputMistake
from pytest_twin.identification.effort.least_squares import LinearProblem, Solution, dry_levels
from pytest_twin.identification.effort.recording_rows import RecordingRows

_SURE = 6.0
"""Number of standard deviations above which a change is significant."""
_DRIFT = 0.15
"""Relative change of friction over a recording above which it is reported."""
_ZERO_DRIFT = 0.05
"""Change of the constant effort, relative to the joint's RMS effort, above which it is reported."""
_FEWEST_ROWS, _BLOCKS = 100, 20
"""Fewest samples of a moving joint for a trend, and number of time blocks."""
_WARM = "record after the robot is warm, or identify cold and warm recordings apart"


def drifts(
    problem: LinearProblem,
    fitted: Solution,
    samples: Sequence[RecordingRows],
    viscous: Mapping[str, float],
) -> list[InputMistake]:
    """Detect joints whose friction or constant effort changes over a recording.

    The residual is fitted by dry friction, viscous friction and a constant effort, each with a
    linear trend in time. Deviations allow for residuals that are correlated within blocks of time.

    Args:
        problem, fitted: problem and fit of all columns that the motion excites. A drift makes
            parameters look insignificant, so the essential ones alone would not do.
        samples: rows of the recordings.
        viscous: joint -> fitted coefficient of viscous friction, of all joints in order.
    """
    velocity = np.concatenate([s.velocity for s in samples])
    share = np.concatenate([(s.time - s.time[0]) / np.ptp(s.time) - 0.5 for s in samples])
    dry = dry_levels(problem, fitted.values)
    found = []
    for k, joint in enumerate(viscous):
        use = problem.known[:, k] & ~problem.resting[:, k]
        if use.sum() < _FEWEST_ROWS:
            continue
        speed = velocity[use, k]
        usual = float(np.sqrt(np.mean(speed**2)))
        laws = np.column_stack([np.sign(speed), speed / usual, np.ones(len(speed))])
        rows = np.column_stack([laws, laws * share[use][:, None]])
        trend, std = (x[3:] for x in _with_deviations(rows, fitted.residual[use, k]))
        sure = np.abs(trend) > _SURE * std
        friction = dry[k] + abs(viscous[joint]) * usual
        effort = float(np.sqrt(np.mean(problem.effort[use, k] ** 2)))
        if sure[0] and abs(trend[0]) > _DRIFT * dry[k] > 0.0:
            found.append(_mistake(joint, "dry friction", 100.0 * trend[0] / dry[k]))
        if sure[1] and abs(trend[1]) > _DRIFT * friction > 0.0:
            found.append(_mistake(joint, "viscous friction", 100.0 * trend[1] / friction))
        if sure[2] and abs(trend[2]) > _ZERO_DRIFT * effort:
            found.append(InputMistake(
                joint,
                f"{joint}: the constant effort changes by {100 * trend[2] / effort:+.0f} % of the "
                "usual effort over a recording: the zero of its sensor drifts",
                "set the zero of the effort when the robot is warm, or record for a shorter time",
                is_fatal=False,
            ))  # fmt: skip
    return found


def _mistake(joint: str, what: str, percent: float) -> InputMistake:
    of = " of the whole friction" if what.startswith("viscous") else ""
    return InputMistake(
        joint,
        f"{joint}: {what} changes by {percent:+.0f} %{of} over a recording: the gear warms up, or "
        "its load changes",
        _WARM,
        is_fatal=False,
    )


def _with_deviations(rows: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return least squares and its deviations for residuals that are correlated within blocks."""
    found, *_ = np.linalg.lstsq(rows, values, rcond=None)
    off = values - rows @ found
    inverse = np.linalg.pinv(rows.T @ rows)
    parts = np.array_split(np.arange(len(rows)), _BLOCKS)
    scores = np.array([rows[p].T @ off[p] for p in parts])
    # The factor corrects for few blocks (Cameron and Miller, J. Human Resources 50, 2015).
    covariance = _BLOCKS / (_BLOCKS - 1.0) * inverse @ (scores.T @ scores) @ inverse
    return np.asarray(found, dtype=np.float64), np.sqrt(np.diag(covariance).clip(1e-300))
