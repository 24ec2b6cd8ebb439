"""Compare kinematics and dynamics of a robot before and after a conversion."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.asset.loss.description import Description, Dynamics
from pytest_twin.asset.loss.matrix import Item, Row, Verdict
from pytest_twin.asset.loss.table import EXACT, SINGLE, largest_magnitude
from pytest_twin.metrics.pose import direction_error, inverse, orientation_error

Vector = NDArray[np.float64]
_STEP = 0.1
"""Displacement of a joint, rad or m, for the comparison of directions."""
_PARALLEL = 1e-12
"""Length below which a vector has no direction; rounding errors are smaller."""
_LEAST_MASS = 1e-6
"""kg: a lighter robot has placeholder masses, so its centre of mass is not compared."""


def rows(
    source: Description,
    target: Description,
    reference: Dynamics,
    by: str,
    poses: list[dict[str, float]],
) -> Iterable[Row]:
    """Yield rows on poses, directions, mass, gravity torque, mass matrix and default state.

    Args:
        source, target: the robot before and after the conversion.
        reference: the source robot in a different engine than the target's.
        by: name of the reference engine.
        poses: configurations: joint -> rad or m.
    """
    ran = f"{by} against {target.engine} at {len(poses)} configurations"
    frames = [name for name in reference.frames if name in target.dynamics.frames]
    # np.maximum keeps NaN, which counts as a difference; max() would drop it.
    metres = radians = 0.0
    for q in poses:
        first, second = reference.poses(q), target.dynamics.poses(q)
        for frame in frames:
            one, two = first[frame], second[frame]
            metres = float(np.maximum(metres, np.abs(one - two)[:3, 3].max()))
            radians = float(np.maximum(radians, orientation_error(one[:3, :3], two[:3, :3])))
    what = f"{len(frames)} frames"
    yield _measured("forward kinematics, position", what, ran, _Difference(metres, "m"))
    yield _measured("forward kinematics, orientation", what, ran, _Difference(radians, "rad"))
    yield _directions(target, reference, by)
    mass = reference.mass(), target.dynamics.mass()
    yield _measured(
        "mass",
        f"{mass[0]:.9g} kg",
        f"{by} against {target.engine}, all bodies",
        _Difference(abs(mass[0] - mass[1]), "kg", max(mass[0], 1e-3)),
        after=f"{mass[1]:.9g} kg",
    )
    if min(mass) > _LEAST_MASS:
        centres = [reference.center_of_mass(q) - target.dynamics.center_of_mass(q) for q in poses]
        centre = largest_magnitude(np.array(centres))
        yield _measured("centre of mass", "of all bodies", ran, _Difference(centre, "m"))
    mine, theirs = _orders(reference, target.dynamics, poses[0])
    names = f"{len(mine)} joints"
    torque, largest = 0.0, 1.0
    matrix, heaviest = 0.0, 1e-3
    for q in poses if mine else []:
        one, two = reference.gravity_torque(q)[mine], target.dynamics.gravity_torque(q)[theirs]
        torque, largest = (
            np.maximum(torque, largest_magnitude(one - two)),
            max(largest, largest_magnitude(one)),
        )
        big = reference.mass_matrix(q)[np.ix_(mine, mine)]
        other = target.dynamics.mass_matrix(q)[np.ix_(theirs, theirs)]
        matrix, heaviest = (
            np.maximum(matrix, largest_magnitude(big - other)),
            max(heaviest, largest_magnitude(big)),
        )
    yield _measured("gravity torque", names, ran, _Difference(float(torque), "N*m or N", largest))
    yield _measured(
        "mass matrix", names, ran, _Difference(float(matrix), "kg*m^2, kg*m or kg", heaviest)
    )
    yield _default_state(source, target)


def _orders(
    first: Dynamics, second: Dynamics, shared: Mapping[str, float]
) -> tuple[list[int], list[int]]:
    """Return the indices of the shared joints in both orders."""
    return (
        [first.joints.index(name) for name in shared],
        [second.joints.index(name) for name in shared],
    )


@dataclass(frozen=True, slots=True)
class _Difference:
    """Difference of two quantities, in ``unit``; below 1e-9 of ``scale`` it counts as exact."""

    value: float
    unit: str
    scale: float = 1.0


def _measured(
    feature: str,
    before: str,
    ran: str,
    measured: _Difference,
    *,
    after: str | None = None,
    items: tuple[Item, ...] = (),
) -> Row:
    difference, scale, unit = measured.value, measured.scale, measured.unit
    verdict: Verdict = "kept" if difference <= EXACT * scale else "changed"
    shown = after or before
    if verdict == "changed" and after is None:
        shown = f"{before}, off by up to {difference:.3g} {unit}"
    # A comparison with NaN is False, so NaN exceeds the tolerance.
    critical = not difference <= SINGLE * scale
    if not math.isfinite(difference):
        verdict, critical = "changed", True
    return Row(
        feature, verdict, before, shown, ran, difference, EXACT * scale, unit, items, critical
    )


def _directions(target: Description, reference: Dynamics, by: str) -> Row:
    """Compare the screw axis of the motion when each joint moves alone from zero."""
    shared = [name for name in reference.joints if name in target.dynamics.joints]
    frames = [name for name in reference.frames if name in target.dynamics.frames]
    home_one, home_two = reference.poses({}), target.dynamics.poses({})
    items, worst = [], 0.0
    for name in shared:
        one, two = reference.poses({name: _STEP}), target.dynamics.poses({name: _STEP})
        angle = 0.0
        for frame in frames:
            first = _screw(one[frame] @ inverse(home_one[frame]))
            if first is None:
                continue
            second = _screw(two[frame] @ inverse(home_two[frame]))
            angle = math.pi if second is None else direction_error(first, second)
            break
        worst = float(np.maximum(worst, angle))
        if not angle <= SINGLE:
            turned_round = "reversed" if angle > math.pi / 2 else "about another axis"
            items.append(Item(name, "changed", "as stated", f"{turned_round}, {angle:.4g} rad"))
    ran = f"each joint moved by {_STEP:g} rad or m alone, {by} against {target.engine}"
    return _measured(
        "direction of every joint",
        f"{len(shared)} joints",
        ran,
        _Difference(worst, "rad"),
        items=tuple(items),
    )


def _screw(motion: Vector) -> Vector | None:
    """Return the unit direction of a motion's rotation, else of its translation, else None."""
    skew = motion[:3, :3] - motion[:3, :3].T
    axis = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        axis = motion[:3, 3]
        length = float(np.linalg.norm(axis))
    return None if length < _PARALLEL else axis / length


def _default_state(source: Description, target: Description) -> Row:
    items = []
    worst = 0.0
    shared = [name for name in source.joints if name in target.joints]
    for name in shared:
        apart = abs(source.joints[name].default - target.joints[name].default)
        worst = max(worst, apart)
        if apart > EXACT:
            stated = (source.joints[name].default, target.joints[name].default)
            items.append(Item(name, "changed", *(f"{value:.6g}" for value in stated)))
    ran = f"joint values as {target.engine} loads the model"
    return _measured(
        "default state",
        f"{len(shared)} joints at zero",
        ran,
        _Difference(worst, "rad or m"),
        items=tuple(items),
    )
