"""Widen ranges if held-out recordings deviate more than the parameters' covariance predicts.

Standard deviations are multiplied by the larger of two ratios. The Birge ratio (Physical Review 40,
1932), which metrology uses for results with more scatter than their uncertainties predict, is the
root of the observed over the predicted mean square. The second ratio is the quantile of the
deviations over the predicted half width, from the recording where it is largest (normalized split
conformal prediction; Lei et al., Journal of the American Statistical Association 113, 2018). It is
computed by recording, because samples of one recording are not independent. The envelope then
covers the stated fraction of each held-out recording. A ratio is applied only if few simulated
robots deviate as much.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtri

from pytest_twin.arrays import FloatArray
from pytest_twin.ranges.distribution import Coordinate, Distribution
from pytest_twin.ranges.simulate import Traces

LEVEL = 0.2
"""Fraction of simulated robots with such a deviation below which a joint is widened. Too narrow
ranges cost more than slightly too wide ones, so one joint in five being widened without need is
accepted.
"""
ROUNDS = 4
"""Number of iterations. Friction and joint stops are non-linear and the joints are coupled, so the
factors are determined again with the wider ranges."""
_SETTLED = 0.15
"""Tolerance of the ratio of observed to predicted deviation. With 128 robots the latter is accurate
to 6 %."""
_UNEXPLAINED = 0.5
"""The same tolerance, beyond which even the best factor does not explain the observed deviation."""
LARGEST = 30.0
"""Largest factor. Beyond it, the cause is not the parameters: one with an uncertainty of 1 % would
have 30 %. With a limit of 10, the coverage of one concealed arm in four was 88 %."""
_NAME = "held-out recordings deviate more than the covariance predicts"

Simulate = Callable[[Distribution], Sequence[Traces]]


@dataclass(frozen=True)
class Deviation:
    """Observed deviation of one joint from the mean of the robots, relative to the prediction.

    Attributes:
        ratio: factor by which the predicted deviations are too small.
        chance: fraction of simulated robots that deviate as much.
    """

    ratio: float
    chance: float


def fewest_robots(joints: int) -> int:
    """Return the number of robots with which the deviation of each joint can be significant.

    Each of the joints is tested at the level ``LEVEL / joints``, and of ``n`` robots the smallest
    p-value is ``1 / (n + 1)``.
    """
    return math.ceil(max(joints, 1) / LEVEL)


def widen(
    start: Distribution,
    simulate: Simulate,
    noise: Mapping[str, float],
    carrying: Mapping[str, Sequence[str]],
    share: float,
) -> tuple[Distribution, dict[str, Any]]:
    """Return the widened distribution, and the factors with their derivation.

    Args:
        start: distribution from records, trials and tolerances.
        simulate: function from a distribution to traces of the held-out recordings.
        noise: joint -> standard deviation of a reading, rad or m.
        carrying: joint -> itself and the joints that carry its link.
        share: fraction of the samples that the envelope should cover.
    """
    first = last = deviations(simulate(start), noise, share)
    level = LEVEL / max(len(first), 1)
    factors = {joint: 1.0 for joint, one in first.items() if one.chance < level and one.ratio > 1.0}
    found = start
    best = {joint: (1.0, first[joint].ratio) for joint in factors}
    closest = (_distance(first, factors), found, dict(factors), first)
    for _ in range(ROUNDS if factors else 0):
        for joint, factor in factors.items():
            factors[joint] = _next_factor(factor, last[joint].ratio, best[joint])
        found = start.widened([_factor(one, factors, carrying) for one in start.coordinates], _NAME)
        last = deviations(simulate(found), noise, share)
        for joint, factor in factors.items():
            if last[joint].ratio < best[joint][1]:
                best[joint] = (factor, last[joint].ratio)
        distance = _distance(last, factors)
        if distance < closest[0]:
            closest = (distance, found, dict(factors), last)
        if all(_has_settled(factors[joint], last[joint].ratio) for joint in factors):
            break
    _, found, factors, last = closest
    return found, {
        "rule": f"where fewer than {100 * LEVEL:.0f} % of the simulated robots deviate as much as "
        "the held-out recordings, standard deviations of a joint's parameters grow by "
        "the larger of Birge's ratio and the conformal quantile ratio, those of a link's inertia "
        f"by the least factor of the joints that carry it; at most {LARGEST:.0f} times",
        "factors": factors,
        "before": {joint: _json(one) for joint, one in first.items()},
        "after": {joint: _json(one) for joint, one in last.items()},
        "unexplained": [
            joint
            for joint, factor in factors.items()
            if factor >= LARGEST or last[joint].ratio > 1.0 + _UNEXPLAINED
        ],
    }


def _factor(
    one: Coordinate, factors: Mapping[str, float], carrying: Mapping[str, Sequence[str]]
) -> float:
    """Return the factor of a coordinate's standard deviation.

    The inertia of a link affects every joint that carries it, so its factor is the smallest of
    these joints' factors.
    """
    if one.joint is None:
        return 1.0
    joints = [one.joint] if one.body is None else carrying.get(one.joint, [one.joint])
    return min(factors.get(joint, 1.0) for joint in joints)


def _next_factor(factor: float, ratio: float, best: tuple[float, float]) -> float:
    """Return the factor to try next.

    With too much friction some simulated robots do not move at all, so that a larger factor can
    reduce their spread. After a factor that increased the ratio, the geometric mean of it and the
    best factor is tried.

    Args:
        factor, ratio: last factor tried, and the ratio with it.
        best: factor with the smallest ratio so far, and this ratio.
    """
    if ratio > best[1]:
        return float(np.sqrt(factor * best[0]))
    return float(np.clip(factor * ratio, 1.0, LARGEST))


def _distance(found: Mapping[str, Deviation], factors: Mapping[str, float]) -> float:
    """Return the largest ``|log(ratio)|`` of the widened joints; 0 if all deviate as predicted."""
    return max((abs(float(np.log(max(found[j].ratio, 1e-9)))) for j in factors), default=0.0)


def _has_settled(factor: float, ratio: float) -> bool:
    """Whether a factor explains the observed deviation, or is at its limit."""
    return abs(ratio - 1.0) < _SETTLED or (factor >= LARGEST and ratio > 1.0)


def _json(one: Deviation) -> dict[str, float]:
    return {"ratio": one.ratio, "chance": one.chance}


def deviations(
    traces: Sequence[Traces], noise: Mapping[str, float], share: float
) -> dict[str, Deviation]:
    """Return joint -> deviation from the mean of the robots, over all recordings."""
    found = {}
    for joint in dict.fromkeys(j for one in traces for j in one.joints):
        std = noise.get(joint, 0.0)
        own = [
            (one.robots[:, :, one.joints.index(joint)].astype(np.float64),
             one.measured[:, one.joints.index(joint)])
            for one in traces if joint in one.joints
        ]  # fmt: skip
        predicted, square, reached = [], 0.0, []
        for robots, measured in own:
            middle = np.nanmean(robots, axis=0)
            predicted.append(np.nansum((robots - middle) ** 2, axis=1))
            off = np.abs(measured - middle)
            square += float(np.sum(off**2))
            deviation = np.sqrt(np.nanvar(robots, axis=0) + std**2)
            half = np.maximum(float(ndtri(0.5 + 0.5 * share)) * deviation, 1e-300)
            reached.append(float(np.quantile(off / half, share, method="higher")))
        samples = sum(len(measured) for _, measured in own)
        birge = _birge(square, np.sum(predicted, axis=0), samples * std**2)
        # With fewer than twenty recordings the quantile over recordings is the maximum.
        conformal = float(np.quantile(reached, share, method="higher"))
        found[joint] = Deviation(max(birge.ratio, conformal), birge.chance)
    return found


def _birge(observed: float, predicted: FloatArray, noise: float) -> Deviation:
    """Compute the Birge ratio from sums of squares; noise is added to each robot's deviation."""
    chance = float((np.sum(predicted + noise >= observed) + 1.0) / (len(predicted) + 1.0))
    mean = float(predicted.mean())
    excess = max(observed - noise, 0.0)
    ratio = float(np.sqrt(excess / mean)) if mean > 0.0 else (LARGEST if excess > 0.0 else 1.0)
    return Deviation(ratio, chance)
