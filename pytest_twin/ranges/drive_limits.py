"""Limits of drawn drives by other values of the same robot.

The back-EMF of a drive is a part of its joint's damping.

Models hold back-EMF as passive damping, together with the viscous friction of motor and gear. Some
effects take the back-EMF out of it, because a drive that is switched off or saturated has none. If
it were more than the whole, the rest of the damping would be negative: the joint would generate
energy and turn faster and faster.

Friction that the motor's own effort causes at rest and in motion adds up. If it were as large as
the effort, the drive could never start its joint.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.effects import catalogue, effect_of_field
from pytest_twin.ranges.distribution import Coordinate, Distribution, UpperLimit
from pytest_twin.realization import Realization


@dataclass(frozen=True, slots=True)
class _Part:
    """A parameter of an effect that is a part of its joint's damping."""

    effect: str
    parameter: str
    joint: str
    value: float


def with_passive_joints(
    distribution: Distribution,
    realization: Realization,
    patched: PatchedModel | None,
    notes: list[str],
) -> Distribution:
    """Return the distribution without joints whose back-EMF exceeds their damping.

    Where both vary, the back-EMF of a robot is at most its damping. Where one of them varies, the
    other one is its bound.

    Args:
        distribution: coordinates of the records.
        realization: the model, which has the twin's damping.
        patched: effects of the twin, if any.
        notes: list to which a message is added if the twin itself exceeds its damping.
    """
    coordinates = list(distribution.coordinates)
    places = {(one.effect, one.parameter, one.joint): k for k, one in enumerate(coordinates)}
    names = {one.name: k for k, one in enumerate(coordinates)}
    for part in _parts(patched):
        place = places.get((part.effect, part.parameter, part.joint))
        at = names.get(f"{part.joint}.{effect_of_field('damping').id}")
        own, added, is_written = _damping(realization, patched, part.joint)
        whole = own if is_written else own + added
        if part.value > whole:
            notes.append(
                f"{part.joint}: the back-EMF of {part.effect} ({part.value:.3g}) exceeds the "
                f"whole damping of the joint ({whole:.3g}): drawn robots have at most the whole"
            )
        if at is None:
            if place is not None:
                upper = min(coordinates[place].upper, max(whole, 0.0))
                coordinates[place] = replace(coordinates[place], upper=upper)
            continue
        rest = _rest(coordinates[at], own, added, is_written)
        if place is None:
            lower = max(coordinates[at].lower, part.value - rest)
            coordinates[at] = replace(coordinates[at], lower=lower)
        else:
            coordinates[place] = replace(
                coordinates[place], at_most=UpperLimit(coordinates[at].name, rest=rest)
            )
    return replace(distribution, coordinates=tuple(coordinates))


def with_bounded_sums(distribution: Distribution, patched: PatchedModel | None) -> Distribution:
    """Return the distribution in which parameters that a law adds up keep a bound together.

    The bound is that of the parameter to which the other one is added.

    Args:
        distribution: coordinates of the records.
        patched: effects of the twin, if any.
    """
    coordinates = list(distribution.coordinates)
    places = {(one.effect, one.parameter, one.joint): k for k, one in enumerate(coordinates)}
    for effect in () if patched is None else patched.effects:
        laws = {law.name: law for law in catalogue()[effect.effect].parameters}
        for law in laws.values():
            if not law.sums_with:
                continue
            bound = laws[law.sums_with].upper
            added, other = (
                places.get((effect.effect, name, effect.joint))
                for name in (law.name, law.sums_with)
            )
            if added is not None and other is not None:
                limit = UpperLimit(coordinates[other].name, factor=-1.0, rest=bound)
                coordinates[added] = replace(coordinates[added], at_most=limit)
                continue
            for place, name in ((added, law.sums_with), (other, law.name)):
                if place is not None:
                    one = coordinates[place]
                    most = max(bound - effect.values.get(name, 0.0), one.mean)
                    coordinates[place] = replace(one, upper=min(one.upper, most))
    return replace(distribution, coordinates=tuple(coordinates))


def _parts(patched: PatchedModel | None) -> Iterator[_Part]:
    """Yield the parts of a joint's damping among the twin's effects."""
    for one in () if patched is None else patched.effects:
        for law in catalogue()[one.effect].parameters:
            if law.part_of == "damping" and one.joint is not None and law.name in one.values:
                yield _Part(one.effect, law.name, one.joint, one.values[law.name])


def _damping(
    realization: Realization, patched: PatchedModel | None, joint: str
) -> tuple[float, float, bool]:
    """Return damping of the model, the addition by effects, and whether the model contains it."""
    damping = effect_of_field("damping")
    own = float(realization.model.dof_damping[realization.joint_dof_index(joint)])
    found = [
        one for one in (() if patched is None else patched.effects)
        if (one.effect, one.joint) == (damping.id, joint)
    ]  # fmt: skip
    added = sum(one.values.get(damping.parameters[0].name, 0.0) for one in found)
    return own, added, any(one.is_in_mjcf for one in found)


def _rest(whole: Coordinate, own: float, added: float, is_written: bool) -> float:
    """Return the damping that a joint has besides the coordinate of its viscous friction."""
    if whole.field is not None:
        return 0.0 if is_written else added
    return own - added if is_written else own
