"""Fit a structure along the measured motion: all parameters, shapes included, without simulation.

Levenberg-Marquardt on :meth:`Linear.differences`, in which laws are exact and only the deviations
that follow from them are of first order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.diagnosis.fit import propose
from pytest_twin.diagnosis.hypothesis import Hypothesis
from pytest_twin.diagnosis.responses import Linear
from pytest_twin.diagnosis.screen import View
from pytest_twin.effects.base import FloatArray

_DAMPINGS = (1e-4, 1e-2, 1.0)
_ENOUGH = 3e-3
_STEP = 1e-3


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
            rows, steps = _moved(current)
            if not rows:
                break
            columns = linear.differences(rows)
            slope = np.stack(
                [
                    (view.residual - residual - column) / -step
                    for column, step in zip(columns, steps, strict=True)
                ],
                axis=-1,
            )
            tried = [propose(current, residual, slope, weight, d) for d in _DAMPINGS]
            left = [view.residual - change for change in linear.differences(tried)]
            cost = [_cost(r, weight) for r in left]
            before = _cost(residual, weight)
            best = int(np.argmin(cost))
            if not cost[best] < before:
                break
            current, residual = tried[best], left[best]
            if cost[best] > (1.0 - _ENOUGH) * before:
                break
        out.append(Polished(current, residual))
    return out


def _cost(residual: FloatArray, weight: FloatArray) -> float:
    value = float(np.mean((residual * weight) ** 2))
    return value if np.isfinite(value) else np.inf


def _moved(h: Hypothesis) -> tuple[list[Hypothesis], list[float]]:
    _, upper = h.bounds
    rows, steps = [], []
    for k in range(h.theta.size):
        step = _STEP * max(1.0, abs(h.theta[k]))
        step = -step if h.theta[k] + step > upper[k] else step
        theta = h.theta.copy()
        theta[k] += step
        rows.append(h.with_theta(theta))
        steps.append(step)
    return rows, steps
