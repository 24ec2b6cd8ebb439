"""Laws that repeat over a joint's way, at the wavenumber that the recordings ask for.

Slots, magnets and teeth come in tens to hundreds a turn. Over a way of L a wave answers only within
pi/L of its wavenumber: no grid of starting sizes is fine enough for all ways. The residual of the
joint with the largest one is compared with waves all along the range (a periodogram over position
instead of time, through the equation of small deviations), and the best of each law competes.
Deviations are small for a wave that is longer than they are: where a motion is far from followed,
fine ones say nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import (
    CandidateSensitivities,
    NormalEquations,
    ResidualView,
)
from pytest_twin.diagnosis.first_order.sensitivities import Linear, Sensitivity
from pytest_twin.diagnosis.hypothesis import Term
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.effects.base import Parameter

_AT_ONCE = 32
"""Waves of one batch."""
_SHORTEST = 0.05
"""rad or m of way that tells waves apart."""


def search_harmonics(
    linear: Linear, view: ResidualView, terms: Sequence[Term]
) -> list[Sensitivity]:
    """Responses of waves between and beyond those of the grid, the best of each candidate.

    Args:
        linear: around the fit at hand.
        view: its residual.
        terms: candidates; those whose law has a wavenumber are looked at, at one joint.
    """
    joints = len(linear.problem.joints)
    left = np.sqrt(view.mean_square)[:joints] / view.floor[:joints]
    worst = int(left.argmax())
    if left[worst] < VERDICT.stands_out:
        return []
    apart = np.pi / max(_way(linear, worst), _SHORTEST)
    out = []
    for term in terms:
        wave = _wavenumber(term)
        if term.joint != worst or wave is None:
            continue
        finest = min(term.parameters[wave].upper, 1.0 / _off(linear, worst))
        best = _best_of(linear, view, term, wave, _between(term.parameters[wave], apart, finest))
        out += [] if best is None else [best]
    return out


def _wavenumber(term: Term) -> int | None:
    """Number of the parameter that is one, None without any."""
    which = (k for k, p in enumerate(term.parameters) if p.quantity == "wavenumber")
    return next(which, None)


def _way(linear: Linear, joint: int) -> float:
    """rad or m between the ends of where a joint was."""
    q = linear.along.position[..., joint]
    return float(q.max() - q.min())


def _off(linear: Linear, joint: int) -> float:
    """rad or m, rms, by which the prediction of a joint is off; a little at least."""
    along = linear.along
    off = along.position[..., joint] - along.predicted_position[..., joint]
    return max(float(np.sqrt(np.mean(off**2))), 1e-9)


def _between(parameter: Parameter, apart: float, finest: float) -> FloatArray:
    """Wavenumbers ``apart`` from each other, as far as the ``finest``, between the starting sizes;
    all whole ones where no fit moves it.
    """
    if parameter.choice:
        apart = 1.0
    found = np.arange(min(parameter.starts), finest, apart)
    off = np.abs(found[:, None] - np.array(parameter.starts)).min(axis=1)
    kept: FloatArray = found[off >= 0.5 * apart]
    return kept


def _best_of(
    linear: Linear, view: ResidualView, term: Term, wave: int, wavenumbers: FloatArray
) -> Sensitivity | None:
    """Of a term at some wavenumbers, the one that takes most away by itself."""
    size = np.array([p.starts[0] for p in term.parameters])
    sizes: list[tuple[FloatArray, tuple[int, ...]]] = []
    for k in wavenumbers:
        size = size.copy()
        size[wave] = k
        sizes.append((size, term.switches(size)))
    best: list[Sensitivity] = []
    for first in range(0, len(sizes), _AT_ONCE):
        found = [*best, *linear.at_sizes([term], sizes[first : first + _AT_ONCE])]
        if not found:
            # None of these waves changes the prediction.
            continue
        answers = CandidateSensitivities(found)
        lens = NormalEquations(view, answers)
        best = [answers.responses[i] for (i,) in lens.children(lens.bare, 1)]
    return best[0] if best else None
