"""Description of a curve in words."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.unnamed_law.settings import FREE_LAWS
from pytest_twin.effects.unnamed_law import POSITION, Variable


@dataclass(frozen=True, slots=True)
class Curve:
    """A table over one variable.

    Attributes:
        is_friction: whether the table is a level of dry friction instead of a force.
        units: units of the variable and of the force.
        knots, values: (n,) in these units.
        half_width: (n,) half width of the 95 % band.
        occupancy: (n,) share of the samples near each knot.
        valid: range of the variable in the recordings.
    """

    variable: Variable
    is_friction: bool
    units: tuple[str, str]
    knots: FloatArray
    values: FloatArray
    half_width: FloatArray
    occupancy: FloatArray
    valid: tuple[float, float]

    @property
    def peak(self) -> int:
        """Index of the knot with the largest force among those that the joint has passed."""
        passed = self.occupancy > 0.0
        return int(np.argmax(np.where(passed, np.abs(self.values), -1.0)))


def describe_curve(curve: Curve) -> str:
    """Description of the parts of the curve whose band excludes zero, with units."""
    unit, force = curve.units
    intervals = _clear_intervals(curve)
    if not intervals:
        return f"no force above its own uncertainty over the {curve.variable.name}"
    if len(intervals) == 2 and curve.variable is POSITION and not curve.is_friction:
        pair = _describe_attraction(curve, *intervals)
        if pair:
            return pair
    return ", ".join(_describe_interval(curve, s, unit, force) for s in intervals)


def _describe_interval(curve: Curve, inside: slice, unit: str, force: str) -> str:
    values, knots = curve.values[inside], curve.knots[inside]
    peak = float(values[np.argmax(np.abs(values))])
    low, high = float(knots[0]), float(knots[-1])
    if curve.is_friction:
        how = "against motion" if peak > 0.0 else "less friction than the model's"
        amount = f"{abs(peak):.2g} {force} {how}"
    else:
        amount = f"{abs(peak):.2g} {force} in the {'positive' if peak > 0.0 else 'negative'} "
        amount += "direction"
    name = curve.variable.name
    first, last = curve.valid
    room = 0.05 * (last - first)
    at_start, at_end = low <= first + room, high >= last - room
    if at_start and at_end:
        return f"up to {amount} over the whole {name} range"
    if at_start or at_end:
        side = f"below {high:.2g}" if at_start else f"above {low:.2g}"
        return f"up to {amount} {side} {unit} ({name})"
    # A part may have a single knot; it extends halfway to its neighbours.
    spacing = (curve.knots[-1] - curve.knots[0]) / (len(curve.knots) - 1)
    middle, half = 0.5 * (low + high), 0.5 * max(high - low, float(spacing))
    return f"{amount} within {half:.2g} {unit} of {middle:.2g} {unit} ({name})"


def _describe_attraction(curve: Curve, first: slice, second: slice) -> str | None:
    """Description of two neighbouring parts of opposite sign as attraction or repulsion."""
    a, b = (float(curve.values[s][np.argmax(np.abs(curve.values[s]))]) for s in (first, second))
    gap = float(curve.knots[second.start] - curve.knots[first.stop - 1])
    width = float(curve.knots[second.stop - 1] - curve.knots[first.start])
    if a * b >= 0.0 or gap > 0.5 * width:
        return None
    between = slice(first.start, second.stop)
    signs = np.signbit(curve.values[between])
    at = first.start + int(np.flatnonzero(np.diff(signs))[0])
    x, y = curve.knots[at : at + 2], curve.values[at : at + 2]
    center = float(x[0] - y[0] * (x[1] - x[0]) / (y[1] - y[0]))
    unit, force = curve.units
    how = "a pull towards" if a > 0.0 else "a push away from"
    return (
        f"{how} {center:.2g} {unit} of up to {max(abs(a), abs(b)):.2g} {force}, within "
        f"{0.5 * width:.2g} {unit} of it"
    )


def _clear_intervals(curve: Curve) -> list[slice]:
    """Stretches of knots with a clear force of one sign, the strongest few in their order."""
    size = np.abs(curve.values)
    clear = (size > curve.half_width) & (size > FREE_LAWS.described * size[curve.peak])
    label = np.where(clear, np.sign(curve.values), 0.0)
    ends = np.flatnonzero(np.diff(np.concatenate([[0.0], label, [0.0]])))
    found = [slice(int(a), int(b)) for a, b in itertools.pairwise(ends) if label[a] != 0.0]
    strongest = sorted(found, key=lambda s: -float(size[s].max()))[: FREE_LAWS.most_stretches]
    return sorted(strongest, key=lambda s: s.start)


__all__ = ["Curve", "describe_curve"]
