"""Search for the wavenumber of laws that are periodic in the joint position.

Motors and gears have tens to hundreds of slots, magnets and teeth in a turn. Over a travel L a wave
is visible only within pi/L of its wavenumber, so no fixed grid of starting sizes is fine enough.
The residual of the worst joint is compared with waves over the whole range of wavenumbers. This is
a periodogram over position instead of time, through the linearized dynamics. The best wave of each
law becomes a candidate. Waves shorter than the prediction error are left out, because the
linearization is not valid for them.
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
from pytest_twin.diagnosis.first_order.sensitivities import Linearization, Sensitivity
from pytest_twin.diagnosis.first_order.settings import FIRST_ORDER
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.effects.base import Parameter
from pytest_twin.estimation.hypothesis import Term

_AT_ONCE = 32
"""Number of waves in a batch."""


def search_harmonics(
    linear: Linearization, view: ResidualView, terms: Sequence[Term]
) -> list[Sensitivity]:
    """Sensitivities to waves between and beyond those of the grid, the best of each candidate.

    Args:
        linear: linearization around the present hypothesis.
        terms: candidates; only laws with a wavenumber at the worst joint are searched.
    """
    joints = len(linear.problem.joints)
    residual = np.sqrt(view.mean_square)[:joints] / view.floor[:joints]
    worst = int(residual.argmax())
    if residual[worst] < VERDICT.identifiable:
        return []
    spacing = np.pi / max(_travel(linear, worst), FIRST_ORDER.least_travel)
    out = []
    for term in terms:
        wave = _wavenumber(term)
        if term.joint != worst or wave is None:
            continue
        largest = min(term.parameters[wave].upper, 1.0 / _prediction_error(linear, worst))
        wavenumbers = wavenumbers_to_search(term.parameters[wave], spacing, largest)
        best = _best_wave(linear, view, term, wave, wavenumbers)
        out += [] if best is None else [best]
    return out


def _wavenumber(term: Term) -> int | None:
    """Index of the parameter that is a wavenumber; None without one."""
    which = (k for k, p in enumerate(term.parameters) if p.quantity == "wavenumber")
    return next(which, None)


def _travel(linear: Linearization, joint: int) -> float:
    """Range of the positions of a joint, rad or m."""
    q = linear.trajectory.position[..., joint]
    return float(q.max() - q.min())


def _prediction_error(linear: Linearization, joint: int) -> float:
    """RMS prediction error of a joint, rad or m; at least 1e-9."""
    trajectory = linear.trajectory
    error = trajectory.position[..., joint] - trajectory.predicted_position[..., joint]
    return max(float(np.sqrt(np.mean(error**2))), 1e-9)


def wavenumbers_to_search(parameter: Parameter, spacing: float, largest: float) -> FloatArray:
    """Wavenumbers up to ``largest`` that are not close to a starting size.

    Their distance is ``spacing``, or 1 if the wavenumber takes integer values only.
    """
    if parameter.choice:
        spacing = 1.0
    found = np.arange(min(parameter.starts), largest, spacing)
    distance = np.abs(found[:, None] - np.array(parameter.starts)).min(axis=1)
    kept: FloatArray = found[distance >= 0.5 * spacing]
    return kept


def _best_wave(
    linear: Linearization, view: ResidualView, term: Term, wave: int, wavenumbers: FloatArray
) -> Sensitivity | None:
    """The sensitivity of a term at the wavenumber that alone reduces the residual most."""
    size = np.array([p.starts[0] for p in term.parameters])
    sizes: list[tuple[FloatArray, tuple[int, ...]]] = []
    for k in wavenumbers:
        size = size.copy()
        size[wave] = k
        sizes.append((size, term.amplitude_indices(size)))
    best: list[Sensitivity] = []
    for first in range(0, len(sizes), _AT_ONCE):
        found = [*best, *linear.at_sizes([term], sizes[first : first + _AT_ONCE])]
        candidate_sensitivities = CandidateSensitivities(found)
        equations = NormalEquations(view, candidate_sensitivities)
        best = [
            candidate_sensitivities.responses[i] for (i,) in equations.children(equations.base)[:1]
        ]
    return best[0] if best else None
