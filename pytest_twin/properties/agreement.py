"""Properties that compare each realization of a robot with the first one."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from pytest_twin.asset.loss.description import JointFacts
from pytest_twin.metrics.pose import direction_error, inverse, orientation_error, position_error
from pytest_twin.properties.asset import Asset
from pytest_twin.properties.form import Form
from pytest_twin.properties.violation import Broken

Vector = NDArray[np.float64]
Q = Mapping[str, float]

_STEP = 0.1  # rad or m, displacement of a joint to determine its direction
_MIN_MOTION = 1e-9  # m, below which a motion has no direction
_TINY_INERTIA = 1e-11  # kg*m^2, negligible
_TINY_FORCE = 1e-9  # N*m or N, negligible
_TINY_MASS = 1e-9  # kg, negligible


def _compared_forms(asset: Asset, form: Form) -> str:
    return f"{form.name} against {asset.first.name}"


# -- at a configuration


def forward_kinematics(asset: Asset, q: Q) -> Iterator[Broken]:
    """Every frame has the same pose."""
    first = asset.first.dynamics.poses(q)
    for form in asset.others:
        factor = asset.factor(asset.first, form)
        poses = form.dynamics.poses(q)
        shared = [frame for frame in first if frame in poses]
        if not shared:
            yield _missing("the robot", "no frame of one name", _compared_forms(asset, form))
        for frame in shared:
            apart = position_error(poses[frame][:3, 3], first[frame][:3, 3])
            bound = factor * asset.tolerances.position
            if not apart <= bound:
                yield _deviation(
                    f"frame '{frame}'", "has another position", apart, bound, "m", asset, form
                )
            turned = orientation_error(poses[frame][:3, :3], first[frame][:3, :3])
            bound = factor * asset.tolerances.orientation
            if not turned <= bound:
                yield _deviation(
                    f"frame '{frame}'", "has another orientation", turned, bound, "rad", asset, form
                )


def joint_direction(asset: Asset, q: Q) -> Iterator[Broken]:
    """Every joint moves its links about or along the same axis."""
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
            words = "moves in another direction"
            if one is None or two is None or one[0] != two[0]:
                yield _deviation(f"joint '{joint}'", words, math.inf, bound, "rad", asset, form)
                continue
            apart = direction_error(one[1], two[1])
            if not apart <= bound:
                words = "moves in the opposite direction" if apart > 3.0 else words
                yield _deviation(f"joint '{joint}'", words, apart, bound, "rad", asset, form)


def _first_motion(
    before: Mapping[str, Vector], after: Mapping[str, Vector], frames: list[str]
) -> tuple[str, Vector] | None:
    """First frame that moves, and its direction of rotation or translation."""
    for frame in frames:
        if np.array_equal(after[frame], before[frame]):
            continue
        motion = after[frame] @ inverse(before[frame])
        skew = motion[:3, :3] - motion[:3, :3].T
        turn = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        if np.linalg.norm(turn) > 1e-6:
            return frame, turn
        shift = after[frame][:3, 3] - before[frame][:3, 3]
        if np.linalg.norm(shift) > _MIN_MOTION:
            return frame, shift
    return None


def center_of_mass(asset: Asset, q: Q) -> Iterator[Broken]:
    """The robot has the same mass and the same centre of mass."""
    first = asset.first.dynamics
    for form in asset.others:
        other, factor = form.dynamics, asset.factor(asset.first, form)
        bound = factor * asset.tolerances.mass * first.mass() + _TINY_MASS
        apart = abs(other.mass() - first.mass())
        if not apart <= bound:
            words = f"weighs {other.mass():.6g} kg, not {first.mass():.6g} kg,"
            yield _deviation("the robot", words + " off", apart, bound, "kg", asset, form)
        bound = factor * asset.tolerances.position
        apart = position_error(other.center_of_mass(q), first.center_of_mass(q))
        if first.mass() > _TINY_MASS and not apart <= bound:
            yield _deviation(
                "the centre of mass", "has another position", apart, bound, "m", asset, form
            )


def gravity_torque(asset: Asset, q: Q) -> Iterator[Broken]:
    """Every joint has the same gravity torque."""
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
                words = "has another gravity torque"
                yield _deviation(f"joint '{joint}'", words, apart, bound, unit, asset, form)


def mass_matrix(asset: Asset, q: Q) -> Iterator[Broken]:
    """All elements of the mass matrix are the same."""
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
            words = "have another inertia" if i != k else "has another inertia"
            unit = _inertia_unit(asset, joints[i], joints[k])
            yield _deviation(
                where, words, float(apart[i, k]), float(bounds[i, k]), unit, asset, form
            )


def matrix_of(form: Form, q: Q, joints: tuple[str, ...] | None = None) -> Vector:
    """(n, n) mass matrix without armature, in the order of ``joints``."""
    dynamics = form.dynamics
    names = dynamics.joints
    matrix = np.array(dynamics.mass_matrix(q), dtype=np.float64).reshape(len(names), len(names))
    matrix -= np.diag([form.rotors.get(name, 0.0) for name in names])
    order = [names.index(name) for name in (names if joints is None else joints)]
    return matrix[np.ix_(order, order)]


def gravity_scales(asset: Asset, form: Form, q: Q) -> dict[str, float]:
    """Joint -> upper bound of its gravity torque, N*m or N: g sqrt(M_jj m)."""
    names = form.dynamics.joints
    diagonal = np.maximum(np.diag(matrix_of(form, q)), 0.0)
    gravity = float(np.linalg.norm(form.gravity))
    return {
        name: gravity * math.sqrt(float(diagonal[i]) * asset.carried.get(name, 1.0))
        for i, name in enumerate(names)
    }


# -- independent of the configuration


def joints_and_frames(asset: Asset) -> Iterator[Broken]:
    """The joints and their types are the same, and the frames of one source."""
    first = asset.first.description
    for form in asset.others:
        other = form.description
        for joint, facts in first.joints.items():
            if joint in other.joints:
                held = other.joints[joint].kind
                # In some simulators, a free body has no joint, or a planar one several.
                if facts.kind in ("hinge", "slide") and held != facts.kind:
                    words = f"is a {held}, not a {facts.kind}"
                    yield _missing(f"joint '{joint}'", words, _compared_forms(asset, form))
            elif facts.kind in ("hinge", "slide"):
                yield _missing(f"joint '{joint}'", "is missing", _compared_forms(asset, form))
        for joint, facts in other.joints.items():
            if joint not in first.joints and facts.kind in ("hinge", "slide") and form.complete:
                if any(name.startswith(joint.rsplit("_", 1)[0]) for name in first.joints):
                    continue  # one axis of a planar or floating joint
                yield _missing(
                    f"joint '{joint}'",
                    "is not in the first realization",
                    _compared_forms(asset, form),
                )
        missing = set(first.dynamics.frames) - set(other.dynamics.frames) - {"world"}
        for frame in sorted(missing) if form.complete else ():
            yield _missing(f"frame '{frame}'", "is missing", _compared_forms(asset, form))


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
    """Damping, friction and armature of every joint are the same."""
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
            yield _deviation(
                f"joint '{joint}'", words, abs(before - after), bound, unit, asset, form
            )


def couplings(asset: Asset) -> Iterator[Broken]:
    """The same joints follow the same leaders, with the same ratio and offset."""
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
                yield _missing(where, words, _compared_forms(asset, form))
            elif joint not in one:
                words = f"follows '{two[joint][0]}', and should not"
                yield _missing(where, words, _compared_forms(asset, form))
            elif one[joint][0] != two[joint][0]:
                words = f"follows '{two[joint][0]}', not '{one[joint][0]}'"
                yield _missing(where, words, _compared_forms(asset, form))
            else:
                for what, unit, before, after in (
                    ("follows with another ratio", "", one[joint][1], two[joint][1]),
                    ("follows with another offset", "rad or m", one[joint][2], two[joint][2]),
                ):
                    room = bound * max(1.0, abs(before))
                    if not abs(before - after) <= room:
                        yield _deviation(where, what, abs(before - after), room, unit, asset, form)


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
                    yield _missing(where, words, _compared_forms(asset, form))
                continue
            bound = factor * bounds.mass * one.mass + _TINY_MASS
            apart = abs(one.mass - two.mass)
            if not apart <= bound:
                words = f"weighs {two.mass:.6g} kg, not {one.mass:.6g} kg, off"
                yield _deviation(where, words, apart, bound, "kg", asset, form)
            if one.mass <= _TINY_MASS:
                continue
            bound = factor * bounds.position
            apart = position_error(one.com, two.com)
            if not apart <= bound:
                words = "has another centre of mass"
                yield _deviation(where, words, apart, bound, "m", asset, form)
            bound = factor * bounds.inertia * float(np.abs(one.inertia).max()) + _TINY_INERTIA
            apart = float(np.abs(one.inertia - two.inertia).max())
            if not apart <= bound:
                words = "has another inertia about its centre of mass"
                yield _deviation(where, words, apart, bound, "kg*m^2", asset, form)


def collision_shapes(asset: Asset) -> Iterator[Broken]:
    """The collision shapes of every link have the same extent."""
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
                yield _missing(where, words, pair)
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
        # In URDF, an effort of 0 means that no limit is stated.
        before, after = before or None, after or None
    where = f"joint '{joint}'"
    if before is None and after is None:
        return
    if before is None or after is None:
        words = f"has no {fact}, and should have" if after is None else f"has a {fact} too many"
        value = np.atleast_1d(before if after is None else after)
        numbers = " to ".join(f"{number:.6g}" for number in value)
        yield _missing(where, f"{words} ({numbers} {unit})", _compared_forms(asset, form))
        return
    ends = ("lower end of its range", "upper end of its range") if fact == "range" else (fact,)
    factor = asset.factor(asset.first, form) * asset.tolerances.limit
    for what, a, b in zip(ends, np.atleast_1d(before), np.atleast_1d(after), strict=True):
        bound = factor * max(1.0, abs(float(a)))
        apart = abs(float(a) - float(b))
        # Limits above 1e10 mean that there is none.
        if min(abs(a), abs(b)) < 1e10 and not apart <= bound:
            words = f"has {b:.6g}, not {a:.6g} {unit}, as {what}, off"
            yield _deviation(where, words, apart, bound, unit, asset, form)


def _deviation(
    element: str, what: str, amount: float, bound: float, unit: str, asset: Asset, form: Form
) -> Broken:
    return Broken(element, what, float(amount), float(bound), unit, _compared_forms(asset, form))


def _missing(element: str, what: str, forms: str) -> Broken:
    return Broken(element, what, math.inf, 0.0, "", forms)


def _unit(facts: JointFacts, hinge: str, slide: str) -> str:
    return slide if facts.kind == "slide" else hinge


def _inertia_unit(asset: Asset, one: str, two: str) -> str:
    kinds = [asset.first.description.joints[name].kind for name in (one, two)]
    return ("kg*m^2", "kg*m", "kg")[kinds.count("slide")]
