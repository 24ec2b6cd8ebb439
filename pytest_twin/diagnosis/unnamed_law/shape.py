"""Description of a curve in words, and the known effect with the same shape."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.unnamed_law.settings import FREE_LAWS
from pytest_twin.effects import actuation, friction, transmission
from pytest_twin.effects.unnamed_law import (
    LOAD,
    POSITION,
    SPEED,
    VELOCITY,
    Variable,
)


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


def matching_effect(curve: Curve, *, turns: bool) -> str | None:
    """The id of the simplest effect of the catalogue with nearly this curve; None without one.

    Args:
        turns: whether the joint is a hinge, so that a periodic curve may come from gear or motor.
    """
    for effect, columns in _basis_of_effects(curve).items():
        if _reproduced_share(curve, columns) >= FREE_LAWS.resembles:
            return effect
    if turns and curve.variable is POSITION:
        span = curve.knots[-1] - curve.knots[0]
        for k in range(max(int(np.ceil(FREE_LAWS.periods * 2.0 * np.pi / span)), 1), 201):
            # At least two knots for each period.
            if k * span > np.pi * (len(curve.knots) - 1):
                break
            wave = [np.sin(k * curve.knots), np.cos(k * curve.knots)]
            if curve.is_friction:
                wave.append(np.ones_like(curve.knots))
            if _reproduced_share(curve, np.stack(wave, axis=1)) >= FREE_LAWS.resembles:
                return (
                    friction.PositionDependentFriction.id
                    if curve.is_friction
                    else actuation.Cogging.id
                )
    return None


def _basis_of_effects(curve: Curve) -> Mapping[str, FloatArray]:
    """Effect -> (knots, parameters) basis of the curves that it can have."""
    x = curve.knots
    one = np.ones_like(x)
    known: Mapping[tuple[Variable, bool], Mapping[str, Callable[[], list[FloatArray]]]] = {
        (POSITION, False): {
            transmission.JointSpring.id: lambda: [one, x],
        },
        (VELOCITY, False): {
            friction.ViscousFriction.id: lambda: [x],
            friction.CoulombFriction.id: lambda: [np.sign(x)],
            friction.QuadraticDrag.id: lambda: [x * np.abs(x)],
            friction.AsymmetricFriction.id: lambda: [np.sign(x), one],
        },
        (POSITION, True): {friction.CoulombFriction.id: lambda: [one]},
        (SPEED, True): {
            friction.CoulombFriction.id: lambda: [one],
            friction.ViscousFriction.id: lambda: [x],
            friction.QuadraticDrag.id: lambda: [x**2],
        },
        (LOAD, True): {
            friction.CoulombFriction.id: lambda: [one],
            friction.LoadDependentFriction.id: lambda: [x],
        },
    }
    found = known.get((curve.variable, curve.is_friction), {})
    return {effect: np.stack(columns(), axis=1) for effect, columns in found.items()}


def _reproduced_share(curve: Curve, columns: FloatArray) -> float:
    """Share of the curve's mean square, weighted by occupancy, that a basis reproduces."""
    root = np.sqrt(curve.occupancy)
    target = root * curve.values
    total = float(target @ target)
    if total == 0.0:
        return 0.0
    fit, *_ = np.linalg.lstsq(root[:, None] * columns, target, rcond=None)
    off = target - root * (columns @ fit)
    return 1.0 - float(off @ off) / total


__all__ = ["Curve", "describe_curve", "matching_effect"]
