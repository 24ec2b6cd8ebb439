"""What all realizations of one robot have to agree on, each compared with the first."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from pytest_twin.asset.loss.description import JointFacts
from pytest_twin.metrics.pose import direction_error, orientation_error, position_error
from pytest_twin.properties.asset import Asset
from pytest_twin.properties.broken import Broken
from pytest_twin.properties.form import Form
from pytest_twin.realization.tree import inverse

Vector = NDArray[np.float64]
Q = Mapping[str, float]

_STEP = 0.1  # rad or m that a joint is moved to see its direction
_REST = 1e-9  # m, below which a motion has no direction
_TINY_INERTIA = 1e-11  # kg*m^2, below the inertia of anything that a robot feels
_TINY_FORCE = 1e-9  # N*m or N, likewise
_TINY_MASS = 1e-9  # kg, likewise


def _between(asset: Asset, form: Form) -> str:
    return f"{form.name} against {asset.first.name}"


# -- at a configuration


def forward_kinematics(asset: Asset, q: Q) -> Iterator[Broken]:
    """Every frame stands at the same pose."""
    first = asset.first.dynamics.poses(q)
    for form in asset.others:
        factor = asset.factor(asset.first, form)
        poses = form.dynamics.poses(q)
        shared = [frame for frame in first if frame in poses]
        if not shared:
            yield _absent("the robot", "no frame of one name", _between(asset, form))
        for frame in shared:
            apart = position_error(poses[frame][:3, 3], first[frame][:3, 3])
            bound = factor * asset.tolerances.position
            if not apart <= bound:
                yield _off(f"frame '{frame}'", "stands elsewhere", apart, bound, "m", asset, form)
            turned = orientation_error(poses[frame][:3, :3], first[frame][:3, :3])
            bound = factor * asset.tolerances.orientation
            if not turned <= bound:
                yield _off(f"frame '{frame}'", "is turned", turned, bound, "rad", asset, form)


def joint_direction(asset: Asset, q: Q) -> Iterator[Broken]:
    """Every joint, moved alone, turns or shifts what it carries about or along the same axis."""
    for form in asset.others:
        bound = asset.factor(asset.first, form) * asset.tolerances.orientation
        frames = [frame for frame in asset.first.dynamics.frames if frame in form.dynamics.frames]
        here = [f.dynamics.poses(q) for f in (asset.first, form)]
        for joint in asset.shared(form):
            moved = {**q, joint: q.get(joint, 0.0) + _STEP}
            there = [f.dynamics.poses(moved) for f in (asset.first, form)]
            one, two = (_first_motion(a, b, frames) for a, b in zip(here, there, strict=True))
            if one is None and two is None:
                continue
            words = "moves another way"
            if one is None or two is None or one[0] != two[0]:
                yield _off(f"joint '{joint}'", words, math.inf, bound, "rad", asset, form)
                continue
            apart = direction_error(one[1], two[1])
            if not apart <= bound:
                words = "moves the other way round" if apart > 3.0 else words
                yield _off(f"joint '{joint}'", words, apart, bound, "rad", asset, form)


def _first_motion(
    before: Mapping[str, Vector], after: Mapping[str, Vector], frames: list[str]
) -> tuple[str, Vector] | None:
    """Frame and unit screw of the first frame that moves: what a joint carries moves as one."""
    for frame in frames:
        if np.array_equal(after[frame], before[frame]):
            continue
        motion = after[frame] @ inverse(before[frame])
        skew = motion[:3, :3] - motion[:3, :3].T
        turn = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        if np.linalg.norm(turn) > 1e-6:
            return frame, turn
        shift = after[frame][:3, 3] - before[frame][:3, 3]
        if np.linalg.norm(shift) > _REST:
            return frame, shift
    return None


def center_of_mass(asset: Asset, q: Q) -> Iterator[Broken]:
    """The robot weighs the same, and its centre of mass stands at the same place."""
    first = asset.first.dynamics
    for form in asset.others:
        other, factor = form.dynamics, asset.factor(asset.first, form)
        bound = factor * asset.tolerances.mass * first.mass() + _TINY_MASS
        apart = abs(other.mass() - first.mass())
        if not apart <= bound:
            words = f"weighs {other.mass():.6g} kg, not {first.mass():.6g} kg,"
            yield _off("the robot", words + " off", apart, bound, "kg", asset, form)
        bound = factor * asset.tolerances.position
        apart = position_error(other.center_of_mass(q), first.center_of_mass(q))
        if first.mass() > _TINY_MASS and not apart <= bound:
            yield _off("the centre of mass", "stands elsewhere", apart, bound, "m", asset, form)


def gravity_torque(asset: Asset, q: Q) -> Iterator[Broken]:
    """Gravity asks the same of every joint."""
    first = asset.first.dynamics
    for form in asset.others:
        joints = asset.shared(form)
        one, two = first.gravity_torque(q), form.dynamics.gravity_torque(q)
        scales = gravity_scales(asset, asset.first, q)
        factor = asset.factor(asset.first, form) * asset.tolerances.gravity_torque
        for joint in joints:
            apart = abs(two[form.dynamics.joints.index(joint)] - one[first.joints.index(joint)])
            bound = factor * scales[joint] + _TINY_FORCE
            if not apart <= bound:
                unit = _unit(asset.first.description.joints[joint], "N*m", "N")
                words = "is loaded otherwise by gravity"
                yield _off(f"joint '{joint}'", words, apart, bound, unit, asset, form)


def mass_matrix(asset: Asset, q: Q) -> Iterator[Broken]:
    """Every pair of joints is coupled by the same inertia."""
    for form in asset.others:
        joints = asset.shared(form)
        one, two = (matrix_of(f, q, joints) for f in (asset.first, form))
        scale = np.sqrt(np.outer(np.diag(one), np.diag(one)))
        factor = asset.factor(asset.first, form) * asset.tolerances.mass_matrix
        bounds = factor * scale + _TINY_INERTIA
        apart = np.abs(one - two)
        if joints and not np.all(apart <= bounds):
            i, k = np.unravel_index(int(np.argmax(apart / bounds)), apart.shape)
            where = (
                f"joint '{joints[i]}'"
                if i == k
                else f"joints '{joints[min(i, k)]}' and '{joints[max(i, k)]}'"
            )
            words = "feel another inertia" if i != k else "feels another inertia"
            unit = _inertia_unit(asset, joints[i], joints[k])
            yield _off(where, words, float(apart[i, k]), float(bounds[i, k]), unit, asset, form)


def matrix_of(form: Form, q: Q, joints: tuple[str, ...] | None = None) -> Vector:
    """(n, n) mass matrix without armature, of ``joints`` in their order."""
    dynamics = form.dynamics
    names = dynamics.joints
    matrix = np.array(dynamics.mass_matrix(q), dtype=np.float64).reshape(len(names), len(names))
    matrix -= np.diag([form.rotors.get(name, 0.0) for name in names])
    order = [names.index(name) for name in (names if joints is None else joints)]
    return matrix[np.ix_(order, order)]


def gravity_scales(asset: Asset, form: Form, q: Q) -> dict[str, float]:
    """Joint -> the most that gravity could ask of it, N*m or N: g sqrt(M_jj m)."""
    names = form.dynamics.joints
    diagonal = np.maximum(np.diag(matrix_of(form, q)), 0.0)
    gravity = float(np.linalg.norm(form.gravity))
    return {
        name: gravity * math.sqrt(float(diagonal[i]) * asset.carried.get(name, 1.0))
        for i, name in enumerate(names)
    }


# -- at no configuration: what the realizations hold


def joints_and_frames(asset: Asset) -> Iterator[Broken]:
    """The same joints of the same kinds; of one source, the same frames."""
    first = asset.first.description
    for form in asset.others:
        other = form.description
        for joint, facts in first.joints.items():
            if joint in other.joints:
                held = other.joints[joint].kind
                # A free body needs no joint in some simulators, a planar one several in others.
                if facts.kind in ("hinge", "slide") and held != facts.kind:
                    words = f"is a {held}, not a {facts.kind}"
                    yield _absent(f"joint '{joint}'", words, _between(asset, form))
            elif facts.kind in ("hinge", "slide"):
                yield _absent(f"joint '{joint}'", "is missing", _between(asset, form))
        for joint, facts in other.joints.items():
            if joint not in first.joints and facts.kind in ("hinge", "slide") and form.complete:
                if any(name.startswith(joint.rsplit("_", 1)[0]) for name in first.joints):
                    continue  # one axis of a planar or floating joint
                yield _absent(f"joint '{joint}'", "is one too many", _between(asset, form))
        missing = set(first.dynamics.frames) - set(other.dynamics.frames) - {"world"}
        for frame in sorted(missing) if form.complete else ():
            yield _absent(f"frame '{frame}'", "is missing", _between(asset, form))


def limits(asset: Asset) -> Iterator[Broken]:
    """Range, velocity and effort of every joint are the same."""
    for form in asset.others:
        for joint, one, two in _joint_pairs(asset, form):
            for fact, names in (
                ("range", ("rad", "m")),
                ("velocity", ("rad/s", "m/s")),
                ("effort", ("N*m", "N")),
            ):
                follows = joint in asset.first.description.mimics and fact == "effort"
                if fact in form.carries & asset.first.carries and not follows:
                    yield from _fact(asset, form, joint, fact, one, two, _unit(one, *names))


def passive_terms(asset: Asset) -> Iterator[Broken]:
    """Damping, friction, and armature where both can state it, are the same on every joint."""
    for form in asset.others:
        if "armature" in form.carries & asset.first.carries:
            yield from _rotors(asset, form)
        for joint, one, two in _joint_pairs(asset, form):
            for fact, names in (("damping", ("N*m*s/rad", "N*s/m")), ("friction", ("N*m", "N"))):
                if fact in form.carries & asset.first.carries:
                    yield from _fact(asset, form, joint, fact, one, two, _unit(one, *names))


def _rotors(asset: Asset, form: Form) -> Iterator[Broken]:
    factor = asset.factor(asset.first, form) * asset.tolerances.mass_matrix
    for joint in asset.shared(form):
        before, after = asset.first.rotors[joint], form.rotors[joint]
        bound = factor * before + _TINY_INERTIA
        if not abs(before - after) <= bound:
            words = f"has {after:.6g}, not {before:.6g}, as armature, off"
            unit = _inertia_unit(asset, joint, joint)
            yield _off(f"joint '{joint}'", words, abs(before - after), bound, unit, asset, form)


def couplings(asset: Asset) -> Iterator[Broken]:
    """The same joints follow the same leaders by the same law."""
    first = asset.first
    for form in asset.others:
        if "mimic" not in form.carries & first.carries:
            continue
        bound = asset.factor(first, form) * asset.tolerances.limit
        one, two = first.description.mimics, form.description.mimics
        for joint in sorted({*one, *two}):
            if joint not in first.description.joints or joint not in form.description.joints:
                continue
            where = f"joint '{joint}'"
            if joint not in two:
                words = f"no longer follows '{one[joint][0]}'"
                yield _absent(where, words, _between(asset, form))
            elif joint not in one:
                words = f"follows '{two[joint][0]}', and should not"
                yield _absent(where, words, _between(asset, form))
            elif one[joint][0] != two[joint][0]:
                words = f"follows '{two[joint][0]}', not '{one[joint][0]}'"
                yield _absent(where, words, _between(asset, form))
            else:
                for what, unit, before, after in (
                    ("follows with another ratio", "", one[joint][1], two[joint][1]),
                    ("follows with another offset", "rad or m", one[joint][2], two[joint][2]),
                ):
                    room = bound * max(1.0, abs(before))
                    if not abs(before - after) <= room:
                        yield _off(where, what, abs(before - after), room, unit, asset, form)


def link_inertias(asset: Asset) -> Iterator[Broken]:
    """Every link has the same mass, centre of mass and inertia."""
    first, bounds = asset.first, asset.tolerances
    for form in asset.others:
        if "links" not in form.carries & first.carries or not form.complete:
            continue
        factor = asset.factor(first, form)
        for name, one in first.description.links.items():
            heavy = one.mass > _TINY_MASS or bool(np.any(np.abs(one.inertia) > _TINY_INERTIA))
            two = form.description.links.get(name)
            where = f"link '{name}'"
            if two is None:
                if heavy:
                    words = f"has lost its body of {one.mass:.6g} kg"
                    yield _absent(where, words, _between(asset, form))
                continue
            bound = factor * bounds.mass * one.mass + _TINY_MASS
            apart = abs(one.mass - two.mass)
            if not apart <= bound:
                words = f"weighs {two.mass:.6g} kg, not {one.mass:.6g} kg, off"
                yield _off(where, words, apart, bound, "kg", asset, form)
            if one.mass <= _TINY_MASS:
                continue
            bound = factor * bounds.position
            apart = position_error(one.com, two.com)
            if not apart <= bound:
                words = "has its centre of mass elsewhere"
                yield _off(where, words, apart, bound, "m", asset, form)
            bound = factor * bounds.inertia * float(np.abs(one.inertia).max()) + _TINY_INERTIA
            apart = float(np.abs(one.inertia - two.inertia).max())
            if not apart <= bound:
                words = "has another inertia about its centre of mass"
                yield _off(where, words, apart, bound, "kg*m^2", asset, form)


def collision_shapes(asset: Asset) -> Iterator[Broken]:
    """Every link's collision shapes take the same room."""
    holders = [form for form in asset.forms if "shapes" in form.carries]
    for form in holders[1:]:
        one, two = holders[0].description.shapes, form.description.shapes
        if not (form.complete and holders[0].complete):
            continue
        pair = f"{form.name} against {holders[0].name}"
        for link in sorted({*one, *two}):
            before, after = one.get(link, ()), two.get(link, ())
            where = f"link '{link}'"
            if len(before) != len(after):
                words = f"has {len(after)} collision shapes, not {len(before)}"
                yield _absent(where, words, pair)
                continue
            for a, b in zip(before, after, strict=True):
                size = max(1.0, float(np.abs(a.upper - a.lower).max()))
                bound = asset.factor(holders[0], form) * asset.tolerances.shape * size
                apart = a.apart(b)
                if not apart <= bound:
                    words = f"has a {b} in place of a {a}, off"
                    yield Broken(where, words, apart, bound, "m", pair)


def _joint_pairs(asset: Asset, form: Form) -> Iterator[tuple[str, JointFacts, JointFacts]]:
    for joint, one in asset.first.description.joints.items():
        two = form.description.joints.get(joint)
        if two is not None and one.kind in ("hinge", "slide"):
            yield joint, one, two


def _fact(
    asset: Asset, form: Form, joint: str, fact: str, one: JointFacts, two: JointFacts, unit: str
) -> Iterator[Broken]:
    before, after = getattr(one, fact), getattr(two, fact)
    if fact == "effort":
        # URDF's effort of 0 says that nothing is stated.
        before, after = before or None, after or None
    where = f"joint '{joint}'"
    if before is None and after is None:
        return
    if before is None or after is None:
        words = f"has no {fact}, and should have" if after is None else f"has a {fact} too many"
        value = np.atleast_1d(before if after is None else after)
        numbers = " to ".join(f"{number:.6g}" for number in value)
        yield _absent(where, f"{words} ({numbers} {unit})", _between(asset, form))
        return
    ends = ("lower end of its range", "upper end of its range") if fact == "range" else (fact,)
    factor = asset.factor(asset.first, form) * asset.tolerances.limit
    for what, a, b in zip(ends, np.atleast_1d(before), np.atleast_1d(after), strict=True):
        bound = factor * max(1.0, abs(float(a)))
        apart = abs(float(a) - float(b))
        # Beyond every number that a joint reaches, two bounds are both none.
        if min(abs(a), abs(b)) < 1e10 and not apart <= bound:
            words = f"has {b:.6g}, not {a:.6g} {unit}, as {what}, off"
            yield _off(where, words, apart, bound, unit, asset, form)


def _off(
    element: str, what: str, amount: float, bound: float, unit: str, asset: Asset, form: Form
) -> Broken:
    return Broken(element, what, float(amount), float(bound), unit, _between(asset, form))


def _absent(element: str, what: str, forms: str) -> Broken:
    return Broken(element, what, math.inf, 0.0, "", forms)


def _unit(facts: JointFacts, hinge: str, slide: str) -> str:
    return slide if facts.kind == "slide" else hinge


def _inertia_unit(asset: Asset, one: str, two: str) -> str:
    kinds = [asset.first.description.joints[name].kind for name in (one, two)]
    return ("kg*m^2", "kg*m", "kg")[kinds.count("slide")]
