"""Find patterns in the errors of a calibration, and the part of the cell that they point at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy import stats

from pytest_twin.arrays import FloatArray

CHANCE = 1e-3
"""Significance level of a pattern."""

CONSTANT_SHARE = 0.5
"""Fraction of the squared error that a constant vector must explain to be reported as a bias."""

LEAST_CORRELATION = 0.5
"""Smallest rank correlation between error and reach, or speed, that is reported as growth."""

ALONG_SHARE = 0.5
"""Fraction of a vector's square that must be along gravity, or along the motion."""

_FEWEST = 6
"""Smallest number of errors in which a pattern is searched."""
_FEWEST_OF_PAYLOAD = 3
"""Smallest number of observations with a payload that is compared."""


@dataclass(frozen=True)
class Residuals:
    """Errors of observations, with the quantities that they may depend on.

    Attributes:
        error: (n, 3) predicted minus measured, in the axes of the measuring device, m.
        in_base: (n, 3) the same in the axes of the base, whose z axis is up, m.
        reach: (n,) distance of the flange from the base, m.
        rate: (n, 3) rate of the prediction in the axes of ``error``, m/s; NaN where the
            observation is not part of a motion.
        payloads: payload of each observation, ``""`` if not stated.
    """

    error: FloatArray
    in_base: FloatArray
    reach: FloatArray
    rate: FloatArray
    payloads: Sequence[str]


def pattern_of(found: Residuals) -> dict[str, Any] | None:
    """Return the most specific pattern of the errors; None if they have none.

    The order of the tests is: difference between payloads (elasticity), growth with speed (time
    offset or compliance), constant bias (frame), growth with reach (joint or link geometry).
    """
    if len(found.error) < _FEWEST:
        return None
    return (
        _payloads_apart(found)
        or _grows_with_speed(found)
        or _constant(found.error)
        or _grows_with_reach(found)
    )


def _payloads_apart(found: Residuals) -> dict[str, Any] | None:
    """Test the errors along gravity for differences between payloads (Welch, Bonferroni)."""
    payloads = np.array(found.payloads, dtype=str)
    names = [
        name
        for name in dict.fromkeys(payloads.tolist())
        if name and (payloads == name).sum() >= _FEWEST_OF_PAYLOAD
    ]
    pairs = list(combinations(names, 2))
    best: dict[str, Any] | None = None
    for first, second in pairs:
        one, other = (found.in_base[payloads == name] for name in (first, second))
        apart = one.mean(axis=0) - other.mean(axis=0)
        if apart[2] ** 2 < ALONG_SHARE * float(apart @ apart):
            continue
        test = stats.ttest_ind(one[:, 2], other[:, 2], equal_var=False)
        # Equal errors have zero variance, and the test is then undefined.
        if not test.pvalue * len(pairs) < CHANCE:
            continue
        if best is not None and abs(apart[2]) <= abs(best["difference"]):
            continue
        low, high = test.confidence_interval(0.95)
        best = {
            "kind": "payloads_apart",
            "payloads": [first, second],
            "difference": float(apart[2]),
            "ci95": [float(low), float(high)],
            "words": f"the mean errors with payloads {first} and {second} are "
            f"{1e3 * abs(apart[2]):.2f} mm apart along gravity (95 % interval "
            f"{1e3 * min(abs(low), abs(high)):.2f} to {1e3 * max(abs(low), abs(high)):.2f} mm): "
            "the arm's elasticity. Calibrate with the payload of the task",
        }
    return best


def _grows_with_speed(found: Residuals) -> dict[str, Any] | None:
    moving = np.isfinite(found.rate).all(axis=1)
    if moving.sum() < _FEWEST:
        return None
    rate, error = found.rate[moving], found.error[moving]
    speed = np.linalg.norm(rate, axis=1)
    correlation = _growth(speed, error)
    if correlation is None:
        return None
    made: dict[str, Any] = {"kind": "grows_with_speed", "correlation": correlation}
    words = f"the error grows with speed (rank correlation {correlation:.2f})"
    late = float(np.sum(rate * error) / np.sum(rate**2))
    along = 1.0 - float(np.sum((error - late * rate) ** 2) / np.sum(error**2))
    if along > ALONG_SHARE:
        made |= {"time_offset": late, "unit": "s"}
        made["words"] = (
            f"{words} and {100 * along:.0f} % of it (squared) points along the motion: the robot's "
            f"state is {1e3 * abs(late):.1f} ms {'later' if late > 0 else 'earlier'} than what was "
            "measured. Correct the stamps, or give both as streams"
        )
    else:
        made["words"] = (
            f"{words} and does not point along the motion: compliance of the arm or its mounts"
        )
    return made


def _constant(error: FloatArray) -> dict[str, Any] | None:
    count = len(error)
    mean = error.mean(axis=0)
    total = float(np.sum(error**2))
    explained = count * float(mean @ mean)
    share = explained / max(total, 1e-300)
    # Without a bias, the ratio of sums of squares of independent errors has an F distribution.
    ratio = (explained / 3.0) / max((total - explained) / (3.0 * (count - 1)), 1e-300)
    if share <= CONSTANT_SHARE or stats.f.sf(ratio, 3, 3 * (count - 1)) > CHANCE:
        return None
    return {
        "kind": "constant",
        "bias": mean.tolist(),
        "words": f"a constant bias of {1e3 * np.linalg.norm(mean):.2f} mm makes "
        f"{100 * share:.0f} % of the squared error: a frame is off, not the arm",
    }


def _grows_with_reach(found: Residuals) -> dict[str, Any] | None:
    correlation = _growth(found.reach, found.error)
    if correlation is None:
        return None
    return {
        "kind": "grows_with_reach",
        "correlation": correlation,
        "words": "the error grows with reach (rank correlation "
        f"{correlation:.2f}): joint zeros, link geometry or compliance",
    }


def _growth(cause: FloatArray, error: FloatArray) -> float | None:
    """Return Spearman's rank correlation of distance and cause if it is significant, else None."""
    if np.ptp(cause) < 1e-6:
        return None
    test = stats.spearmanr(cause, np.linalg.norm(error, axis=1), alternative="greater")
    if test.statistic > LEAST_CORRELATION and test.pvalue < CHANCE:
        return float(test.statistic)
    return None
