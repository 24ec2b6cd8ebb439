"""Wider ranges, where held-out recordings deviate more than the parameters' covariance predicts.

Standard deviations grow by the larger of two ratios. Birge's (Physical Review 40, 1932), as
metrology uses it for results that scatter more than their uncertainties say, is the root of the
observed mean square over the predicted one. The other is the quantile of the deviations over the
predicted half width, of the recording where it is largest (normalized split conformal prediction;
Lei et al., Journal of the American Statistical Association 113, 2018; samples of one recording are
no independent evidence, recordings are). The envelope then covers the stated share of each
held-out recording. Either counts only if few simulated robots deviate as much.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtri

from pytest_twin.arrays import FloatArray
from pytest_twin.ranges.distribution import Coordinate, Distribution
from pytest_twin.ranges.simulate import Traces

LEVEL = 0.2
"""Share of simulated robots that deviate as much, below which a joint is widened. Ranges that are
too narrow cost more than ranges a little too wide, so that one joint in five widens without need.
"""
ROUNDS = 4
"""Friction and stops are not linear, and each joint moves with the others: the factors are found
again with the wider ranges."""
_SETTLED = 0.15
"""Of the ratio of observed to predicted deviation; 128 robots know the latter to 6 %."""
LARGEST = 30.0
"""Factor beyond which the parameters are not what is wrong: one that is known to 1 % would be as
uncertain as a third of its value. With 10, coverage of one concealed arm in four was 88 %."""
_NAME = "held-out recordings deviate more than the covariance predicts"

Simulate = Callable[[Distribution], Sequence[Traces]]


@dataclass(frozen=True)
class Deviation:
    """Deviation of one joint from the mean of the robots, over what is predicted.

    Attributes:
        ratio: by which the deviations that are predicted are too small.
        chance: share of the simulated robots that deviate as much.
    """

    ratio: float
    chance: float


def widened(
    start: Distribution,
    simulate: Simulate,
    noise: Mapping[str, float],
    carrying: Mapping[str, Sequence[str]],
    share: float,
) -> tuple[Distribution, dict[str, Any]]:
    """The ranges with the factors that held-out recordings ask for, and how they were found.

    Args:
        start: from records, trials and tolerances.
        simulate: a distribution to traces of the held-out recordings.
        noise: joint -> standard deviation of a reading, rad or m.
        carrying: joint -> itself and the joints that carry its link.
        share: of the samples that the envelope should cover.
    """
    first = last = deviations(simulate(start), noise, share)
    level = LEVEL / max(len(first), 1)
    factors = {joint: 1.0 for joint, one in first.items() if one.chance < level and one.ratio > 1.0}
    found = start
    for _ in range(ROUNDS if factors else 0):
        for joint, factor in factors.items():
            factors[joint] = float(np.clip(factor * last[joint].ratio, 1.0, LARGEST))
        found = start.widened([_factor(one, factors, carrying) for one in start.coordinates], _NAME)
        last = deviations(simulate(found), noise, share)
        if all(_settled(factors[joint], last[joint].ratio) for joint in factors):
            break
    return found, {
        "rule": f"where fewer than {100 * LEVEL:.0f} % of the simulated robots deviate as much as "
        "the held-out recordings, standard deviations of a joint's parameters grow by "
        "the larger of Birge's ratio and the conformal quantile ratio, those of a link's inertia "
        f"by the least factor of the joints that carry it; at most {LARGEST:.0f} times",
        "factors": factors,
        "before": {joint: _json(one) for joint, one in first.items()},
        "after": {joint: _json(one) for joint, one in last.items()},
        "unexplained": [joint for joint, factor in factors.items() if factor >= LARGEST],
    }


def _factor(
    one: Coordinate, factors: Mapping[str, float], carrying: Mapping[str, Sequence[str]]
) -> float:
    """By which a coordinate's standard deviation grows.

    The inertia of a link moves every joint that carries it, so it grows only as far as each of
    these asks for.
    """
    if one.joint is None:
        return 1.0
    joints = [one.joint] if one.body is None else carrying.get(one.joint, [one.joint])
    return min(factors.get(joint, 1.0) for joint in joints)


def _settled(factor: float, ratio: float) -> bool:
    """Whether a factor explains what is observed, or cannot grow."""
    return abs(ratio - 1.0) < _SETTLED or (factor >= LARGEST and ratio > 1.0)


def _json(one: Deviation) -> dict[str, float]:
    return {"ratio": one.ratio, "chance": one.chance}


def deviations(
    traces: Sequence[Traces], noise: Mapping[str, float], share: float
) -> dict[str, Deviation]:
    """Joint -> how far it is from the mean of the robots, over all recordings."""
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
        # Of fewer than twenty recordings the quantile over recordings is the largest.
        conformal = float(np.quantile(reached, share, method="higher"))
        found[joint] = Deviation(max(birge.ratio, conformal), birge.chance)
    return found


def _birge(observed: float, predicted: FloatArray, noise: float) -> Deviation:
    """Of sums of squares; a sum of squares of noise adds to what each robot deviates."""
    chance = float((np.sum(predicted + noise >= observed) + 1.0) / (len(predicted) + 1.0))
    mean = float(predicted.mean())
    excess = max(observed - noise, 0.0)
    ratio = float(np.sqrt(excess / mean)) if mean > 0.0 else (LARGEST if excess > 0.0 else 1.0)
    return Deviation(ratio, chance)
