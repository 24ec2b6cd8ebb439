"""Fit a structure along the measured motion: all parameters, shapes included, without simulation.

Levenberg-Marquardt on :meth:`Linear.differences`, in which laws are exact and only the deviations
that follow from them are of first order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.diagnosis.fit import nudged, propose, weighted_cost
from pytest_twin.diagnosis.hypothesis import Hypothesis
from pytest_twin.diagnosis.responses import Linear
from pytest_twin.diagnosis.screen import View
from pytest_twin.effects.base import FloatArray

_DAMPINGS = (1e-4, 1e-2, 1.0)
_ENOUGH = 3e-3


@dataclass(slots=True)
class Polished:
    """A hypothesis fitted along the measured motion.

    Attributes:
        hypothesis: the one at hand with more terms, every parameter free.
        residual: (bins, signals) what it leaves.
    """

    hypothesis: Hypothesis
    residual: FloatArray


def polish(
    linear: Linear, view: View, starts: Sequence[Hypothesis], iterations: int
) -> list[Polished]:
    """Fit every start; each under the weights of what it leaves."""
    out = []
    for start in starts:
        current = start
        residual = view.residual - linear.differences([current])[0]
        for _ in range(iterations):
            weight = 1.0 / np.sqrt(np.nanmean(residual**2, axis=0) + view.floor**2)
            rows, steps = nudged(current)
            if not rows:
                break
            here, moved = view.residual - residual, linear.differences(rows)
            slope = np.stack([(m - here) / s for m, s in zip(moved, steps, strict=True)], axis=-1)
            tried = [propose(current, residual, slope, weight, d) for d in _DAMPINGS]
            left = [view.residual - change for change in linear.differences(tried)]
            cost = [weighted_cost(r, weight) for r in left]
            before = weighted_cost(residual, weight)
            best = int(np.argmin(cost))
            if not cost[best] < before:
                break
            current, residual = tried[best], left[best]
            if cost[best] > (1.0 - _ENOUGH) * before:
                break
        out.append(Polished(current, residual))
    return out
