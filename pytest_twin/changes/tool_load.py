"""A payload that changed between sessions: mass, centre and inertia of the last link, free.

The catalogue's payload is a point mass at a few places, from which a fit starts. Measured efforts
are linear in mass, first and second moments (Khalil, Dombre 2002, ch. 12.4), so here the place is
free. The last link itself does not change its mass, and a tool on it has the same ten parameters: a
changed load on it is a payload, not another inertial parameter of the link.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.rigid_body import InertialParameters, Payload
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.identification.effort.law_columns import EffortLaws, EffortRows, Shape
from pytest_twin.realization.inverse_dynamics import INERTIAL

_MASS = INERTIAL.index("m")
_FIRST = slice(INERTIAL.index("mx"), INERTIAL.index("mz") + 1)
_INDEPENDENT = 1e-3
"""Share of the effort of a payload's mass that its moments must leave over, so that a mass is
estimated at all: with one joint only the first moment is."""
_EFFORT_ACCURACY = 0.05
"""Relative standard deviation of measured efforts against N*m: data sheets state torque constants
to 10 %. A mass in kg is as uncertain; changes in N*m are not, because the sensor stays the same."""
MOMENTS = 4
"""Number of amplitudes of a payload that are no second moment: mass and three first moments."""


def with_tool_load(
    laws: EffortLaws, parts: Sequence[EffortRows]
) -> tuple[list[EffortRows], tuple[Shape, ...], int]:
    """Rows with columns of a payload with free mass and centre, the shapes, the number of columns.

    Its amplitudes are the mass, kg, the first moments along the payload's own axes, kg*m, and the
    second moments, kg*m^2. Where the mass cannot be told from its moments, nothing is replaced.
    """
    tips = [_in_own_axes(part.tip, laws.tip_axes) for part in parts]
    stacked = np.concatenate([tip.reshape(-1, tip.shape[2]) for tip in tips])
    acts = np.abs(stacked).max(axis=0) > 1e-9 * np.abs(stacked).max()
    others = stacked[:, 1:][:, acts[1:]]
    mass = stacked[:, 0]
    fitted = others @ np.linalg.lstsq(others, mass, rcond=None)[0]
    if np.linalg.norm(mass - fitted) <= _INDEPENDENT * np.linalg.norm(mass):
        return list(parts), laws.shapes, laws.count
    kept = tuple(shape for shape in laws.shapes if not _is_replaced(shape.term, laws.tip))
    needed = np.unique(np.concatenate([shape.indices for shape in kept]))
    places = laws.count + np.arange(stacked.shape[1])
    rows = []
    for part, tip in zip(parts, tips, strict=True):
        columns, matrices = [], []
        for j, (own, matrix) in enumerate(zip(part.columns, part.matrix, strict=True)):
            used = np.isin(own, needed)
            seen = acts & np.abs(tip[:, j]).any(axis=0)
            columns.append(np.concatenate([own[used], places[seen]]))
            matrices.append(np.concatenate([matrix[:, used], tip[:, j, seen]], axis=1))
        rows.append(replace(part, columns=tuple(columns), matrix=tuple(matrices)))
    term = Term(Payload.id, -1)
    neutral = np.array([0.0, 0.0, 0.0, 0.0, 2.0])
    shapes = [
        Shape(term, neutral, {int(k): int(places[k]) for k in np.flatnonzero(acts[:count])})
        for count in (MOMENTS, len(places))
    ]
    return rows, (*kept, *shapes), laws.count + len(places)


def is_tool_load(shape: Shape) -> bool:
    """Whether the amplitudes of a shape are the mass and moments of a payload."""
    return shape.term.effect == Payload.id and len(shape.columns) > 1


def mass_and_place(
    shape: Shape, value: FloatArray, covariance: FloatArray
) -> list[tuple[str, str, float, float]]:
    """Name, unit, value and standard deviation of mass and place of a payload.

    The place is the first moment divided by the mass, so the accuracy of the efforts cancels there;
    its deviation is to first order.

    Args:
        value: (k,) amplitudes of the shape in SI units; covariance: (k, k).
    """
    names = [p.name for p in shape.term.parameters]
    mass = float(value[0])
    deviation = np.hypot(np.sqrt(covariance[0, 0]), _EFFORT_ACCURACY * mass)
    estimates = [(names[0], "kg", mass, float(deviation))]
    for row, k in enumerate(shape.columns):
        if not 0 < k < MOMENTS:
            continue
        place = float(value[row]) / mass
        slope = np.zeros(len(value))
        slope[row], slope[0] = 1.0 / mass, -place / mass
        estimates.append((names[k], "m", place, float(np.sqrt(slope @ covariance @ slope))))
    return estimates


def _in_own_axes(tip: FloatArray, axes: FloatArray) -> FloatArray:
    """(n, joints, 10) effort per unit of mass, first moments along own axes, second moments."""
    first = tip[:, :, _FIRST] @ axes.T
    second = np.delete(tip, [_MASS, *range(_FIRST.start, _FIRST.stop)], axis=2)
    return np.concatenate([tip[:, :, [_MASS]], first, second], axis=2)


def _is_replaced(term: Term, tip: int) -> bool:
    return term.effect == Payload.id or (term.effect == InertialParameters.id and term.joint == tip)
