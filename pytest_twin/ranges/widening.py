"""Wider ranges, where held-out recordings deviate more than the parameters' covariance predicts.

The rule is that of Birge (Physical Review 40, 1932), as metrology uses it for results that scatter
more than their uncertainties say: standard deviations grow by the root of the observed mean square
over the predicted one. Here the predicted one is a simulation, and the excess counts only if hardly
any simulated robot deviates as much.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.ranges.check import LEVEL
from pytest_twin.ranges.distribution import Distribution
from pytest_twin.ranges.simulate import Traces

ROUNDS = 3
"""Friction and stops are not linear: the factors are found again with the wider ranges."""
LARGEST = 10.0
"""Factor beyond which the parameters are not what is wrong."""
_NAME = "held-out recordings deviate more than the covariance predicts (Birge's ratio)"

Simulate = Callable[[Distribution], Sequence[Traces]]


@dataclass(frozen=True)
class Deviation:
    """Mean square deviation of one joint from the mean of the robots, over what is predicted.

    Attributes:
        ratio: root of observed, less noise, over predicted mean square.
        chance: share of the simulated robots that deviate as much.
    """

    ratio: float
    chance: float


def widened(
    start: Distribution, simulate: Simulate, noise: Mapping[str, float]
) -> tuple[Distribution, dict[str, Any]]:
    """The ranges with the factors that held-out recordings ask for, and how they were found.

    Args:
        start: from records, trials and tolerances.
        simulate: a distribution to traces of the held-out recordings.
        noise: joint -> standard deviation of a reading, rad or m.
    """
    factors: dict[str, float] = {}
    first: dict[str, Deviation] = {}
    last: dict[str, Deviation] = {}
    found = start
    for round_ in range(ROUNDS + 1):
        last = deviations(simulate(found), noise)
        first = first or last
        level = LEVEL / max(len(last), 1)
        asked = {
            joint: one.ratio for joint, one in last.items()
            if one.chance < level and one.ratio > 1.0
        }  # fmt: skip
        if not asked or round_ == ROUNDS:
            break
        before = dict(factors)
        for joint, ratio in asked.items():
            factors[joint] = min(LARGEST, factors.get(joint, 1.0) * ratio)
        if factors == before:
            break
        found = start.widened(
            [factors.get(one.joint or "", 1.0) for one in start.coordinates], _NAME
        )
    return found, {
        "rule": "standard deviations of a joint's parameters times the root of observed over "
        f"predicted mean square, where less than {100 * LEVEL:.0f} % (over all joints) of the "
        f"simulated robots deviate as much; at most {LARGEST:.0f} times",
        "factors": factors,
        "before": {joint: _json(one) for joint, one in first.items()},
        "after": {joint: _json(one) for joint, one in last.items()},
        "unexplained": [joint for joint, factor in factors.items() if factor >= LARGEST],
    }


def _json(one: Deviation) -> dict[str, float]:
    return {"ratio": one.ratio, "chance": one.chance}


def deviations(traces: Sequence[Traces], noise: Mapping[str, float]) -> dict[str, Deviation]:
    """Joint -> how far it is from the mean of the robots, over all recordings."""
    found = {}
    for joint in dict.fromkeys(j for one in traces for j in one.joints):
        observed, predicted = 0.0, None
        samples = 0
        for one in traces:
            if joint not in one.joints:
                continue
            column = one.joints.index(joint)
            robots = one.robots[:, :, column].astype(np.float64)
            middle = np.nanmean(robots, axis=0)
            observed += float(np.sum((one.measured[:, column] - middle) ** 2))
            each = np.nansum((robots - middle) ** 2, axis=1)
            predicted = each if predicted is None else predicted + each
            samples += len(middle)
        assert predicted is not None
        found[joint] = _deviation(observed, predicted, samples * noise.get(joint, 0.0) ** 2)
    return found


def _deviation(observed: float, predicted: FloatArray, noise: float) -> Deviation:
    """Of sums of squares; a sum of squares of noise adds to what each robot deviates."""
    chance = float((np.sum(predicted + noise >= observed) + 1.0) / (len(predicted) + 1.0))
    mean = float(predicted.mean())
    excess = max(observed - noise, 0.0)
    ratio = float(np.sqrt(excess / mean)) if mean > 0.0 else (LARGEST if excess > 0.0 else 1.0)
    return Deviation(ratio, chance)
