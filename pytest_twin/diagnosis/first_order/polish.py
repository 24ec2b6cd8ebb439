"""Fit a structure along the measured motion: all parameters, shapes included, without simulation.

Levenberg-Marquardt on :meth:`Linear.differences`, in which laws are exact and only the deviations
that follow from them are of first order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.responses import Linear
from pytest_twin.diagnosis.first_order.screen import View
from pytest_twin.diagnosis.fit import nudged, proposals, weighted_cost
from pytest_twin.diagnosis.hypothesis import Hypothesis
from pytest_twin.realization.forks import free_cores, in_forks

NEARBY, FAR_OFF = 3, 8
"""Iterations of what starts near where it ends, and of what stands for something else."""
_DAMPINGS = (1e-4, 1e-2, 1.0)
_ENOUGH = 3e-3
_FEW, _AT_ONCE = 4, 48
"""Rows of one batch: fewer are not worth a core of their own, more take memory and save no time."""


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
    """Fit every start, side by side; each under the weights of what it leaves."""
    residuals = [view.residual - d for d in _differences(linear, starts)]
    fits = [Polished(h, r) for h, r in zip(starts, residuals, strict=True)]
    active = [f for f in fits if f.hypothesis.theta.size]
    for _ in range(iterations):
        if not active:
            break
        nudges = [nudged(f.hypothesis) for f in active]
        moved = iter(_differences(linear, [row for rows, _ in nudges for row in rows]))
        weights: list[FloatArray] = []
        tried: list[Hypothesis] = []
        ends = [0]
        for f, (_, steps) in zip(active, nudges, strict=True):
            weight = 1.0 / np.sqrt(np.nanmean(f.residual**2, axis=0) + view.floor**2)
            here = view.residual - f.residual
            slope = np.zeros((*here.shape, f.hypothesis.theta.size))
            for column, s in zip(np.flatnonzero(f.hypothesis.movable), steps, strict=True):
                slope[..., column] = (next(moved) - here) / s
            slope = np.nan_to_num(slope, posinf=0.0, neginf=0.0)
            weights.append(weight)
            tried += proposals(f.hypothesis, f.residual, slope, weight, _DAMPINGS)
            ends.append(len(tried))
        left = [view.residual - d for d in _differences(linear, tried)]
        still = []
        for k, (f, weight) in enumerate(zip(active, weights, strict=True)):
            mine = range(ends[k], ends[k + 1])
            best = min(mine, key=lambda i: weighted_cost(left[i], weight))
            before, after = weighted_cost(f.residual, weight), weighted_cost(left[best], weight)
            # Less would only move what is the same physics away from where it is known to be.
            if after <= (1.0 - _ENOUGH) * before:
                f.hypothesis, f.residual = tried[best], left[best]
                still.append(f)
        active = still
    return fits


def _differences(linear: Linear, hypotheses: Sequence[Hypothesis]) -> list[FloatArray]:
    """As :meth:`Linear.differences`, in batches that need the same steps."""
    groups: dict[tuple[bool, bool], list[int]] = {}
    for i, h in enumerate(hypotheses):
        effects = [t.law for t in h.terms]
        key = (
            any(e.remembers for e in effects),
            any(e.overrides("gear") for e in effects),
        )
        groups.setdefault(key, []).append(i)
    cores = free_cores(linear.simulator.threads)
    batches = []
    # What takes the model's own step takes longest.
    for key in sorted(groups, key=lambda k: (k[1], k[0]), reverse=True):
        # All of a batch have all laws of it: those of the same laws go together.
        which = sorted(groups[key], key=lambda i: sorted(t.effect for t in hypotheses[i].terms))
        each = min(_AT_ONCE, max(-(-len(which) // cores), _FEW))
        batches += [which[i : i + each] for i in range(0, len(which), each)]
    if cores > 1:
        linear.know_bodies(hypotheses)
    tasks = [partial(linear.differences, [hypotheses[i] for i in some]) for some in batches]
    out: dict[int, FloatArray] = {}
    for some, found in zip(batches, in_forks(tasks, cores), strict=True):
        out.update(zip(some, found, strict=True))
    return [out[i] for i in range(len(hypotheses))]
