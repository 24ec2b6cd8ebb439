"""Effort and velocity limits of joints, compared with the weight and damping of what they move."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from pytest_twin.audit.asset import Asset, Joint, Vector
from pytest_twin.audit.finding import Finding, finding_of

GRAVITY = 9.81
"""m/s^2."""
MOST_LIFTS = 30.0
"""Efforts that lift the whole robot this many times at its full length are no motor's. Of 68 public
robots, those above it state the placeholder 1000 N*m or 50000 N*m; the strongest real motor lifts
its robot 10 times."""


@dataclass(frozen=True, slots=True)
class Load:
    """What a joint carries.

    Attributes:
        mass: mass of the body and of everything after it, kg.
        com: (3,) their common centre of mass in the root, m.
    """

    mass: float
    com: Vector


def _loads(asset: Asset, placed: Mapping[str, tuple[Vector, Vector]]) -> dict[str, Load]:
    """Return body -> mass and centre of mass of its subtree, for bodies with a finite mass.

    Args:
        placed: body -> (3,) position [m] and (3, 3) rotation in its root.
    """
    masses = {name: max(asset.body[name].mass or 0.0, 0.0) for name in placed}
    moments = {
        name: masses[name] * (position + rotation @ asset.body[name].com)
        for name, (position, rotation) in placed.items()
    }
    for edge in reversed(list(asset.in_order())):
        masses[edge.parent] += masses[edge.child]
        moments[edge.parent] = moments[edge.parent] + moments[edge.child]
    return {
        name: Load(mass, moments[name] / mass)
        for name, mass in masses.items()
        if mass > 0 and np.isfinite(mass) and np.isfinite(moments[name]).all()
    }


def check(asset: Asset) -> Iterator[Finding]:
    """Yield findings of limits that the carried weight or the joint's damping contradicts."""
    if asset.kind != "urdf":
        # The other formats state gravity, springs and force limits elsewhere.
        return
    placed = asset.at({joint.name: _nearest_to_zero(joint) for joint in asset.joints})
    carried = _loads(asset, placed)
    weight = GRAVITY * sum(load.mass for name, load in carried.items() if name in asset.roots)
    length = (
        max((float(np.linalg.norm(load.com)) for load in carried.values()), default=0.0)
        + asset.span
    )
    followers = {mimic.follower for mimic in asset.mimics}
    for joint in asset.joints:
        if not joint.is_scalar or not joint.effort or joint.body not in carried:
            continue
        most = weight * (length if joint.kind == "hinge" else 1.0)
        if joint.effort > MOST_LIFTS * most > 0:
            yield finding_of(
                "joints.effort_units",
                joint.place,
                _element(joint),
                joint.effort,
                title="its effort limit would lift the whole robot "
                f"{joint.effort / most:.0f} times"
                + (" at its full length" if joint.kind == "hinge" else ""),
                unit=joint.effort_unit,
                expected=f"less than {MOST_LIFTS * most:.3g} {joint.effort_unit}",
            )
        if joint.name not in followers:
            yield from _too_weak(joint, carried[joint.body], *placed[joint.body])
        yield from _damped(joint)


def _nearest_to_zero(joint: Joint) -> float:
    """Return the position in a joint's range that is nearest to 0, rad or m."""
    if joint.lower is None or joint.upper is None or not joint.is_limited:
        return 0.0
    return min(max(0.0, joint.lower), joint.upper)


def _too_weak(joint: Joint, load: Load, position: Vector, rotation: Vector) -> Iterator[Finding]:
    """Yield a finding if the effort limit cannot hold the carried links against gravity along -z.

    Args:
        position: (3,) of the joint's body in the root, m.
        rotation: (3, 3) body to root.
    """
    effort = joint.effort or 0.0
    axis = rotation @ joint.axis
    weight = GRAVITY * load.mass
    if joint.kind == "slide":
        needed = weight * abs(float(axis[2]))
    else:
        lever = load.com - position - rotation @ joint.anchor
        needed = weight * abs(float(np.cross(lever, [0.0, 0.0, -1.0]) @ axis))
    if effort < needed:
        yield finding_of(
            "joints.effort_too_small",
            joint.place,
            _element(joint),
            effort,
            title="its effort limit cannot hold the links that it carries, with z up and all "
            "joints at or nearest to 0",
            unit=joint.effort_unit,
            expected=f"more than {needed:.3g} {joint.effort_unit}",
        )


def _damped(joint: Joint) -> Iterator[Finding]:
    if joint.damping and joint.velocity and joint.effort:
        needed = joint.damping * joint.velocity
        if needed > joint.effort:
            yield finding_of(
                "joints.damping_above_effort",
                joint.place,
                _element(joint),
                joint.damping,
                unit=f"{joint.effort_unit}*s/{joint.unit}",
                expected=f"at most {joint.effort / joint.velocity:.3g}; at its velocity limit it "
                f"takes {needed:.3g} {joint.effort_unit}, and its effort limit is "
                f"{joint.effort:g}",
            )


def _element(joint: Joint) -> str:
    return f"joint '{joint.name}'"
