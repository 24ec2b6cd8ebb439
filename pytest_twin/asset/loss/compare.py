"""Hold two forms of a robot together, feature by feature. Pure: both are compiled already."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.asset.loss.description import Description, Dynamics, JointFacts, LinkFacts
from pytest_twin.asset.loss.matrix import Conversion, Item, Row, Verdict
from pytest_twin.realization.tree import RigidTree, inverse

Vector = NDArray[np.float64]

EXACT = 1e-9
"""m, rad, and share of a magnitude: up to here a number is kept."""
SINGLE = 2e-6
"""The same, for what a file holds with single precision: changed, and no fault."""
CLOSE = 1e-5
"""m: corners of shapes, whose vertices every simulator holds with single precision."""
POSES = 5
_STEP = 0.1
_REACH = math.pi
_MOST_ITEMS = 200
_PARALLEL = 1e-12


def compare(
    source: Description, target: Description, reference: Dynamics, reference_name: str
) -> Conversion:
    """All rows of one conversion.

    Args:
        reference: the source robot by an engine that is not the target's.
        reference_name: what that is, for the words of the comparison.
    """
    poses = configurations(source, reference, target.dynamics)
    rows = [
        *_behaviour(source, target, reference, reference_name, poses),
        _links(source, target),
        _joints(source, target),
        _independent(source, target),
        _passive(source, target),
        _actuators(source, target),
        *_limits(source, target),
        _passive_terms(source, target),
        _named("drives", source.drives, target.drives, "feedback terms of the actuators"),
        _mimics(source, target),
        _constraints(source, target),
        _shapes(source, target),
        _disabled(source, target),
        _contact(source, target),
        _sensors(source, target),
        _frames(source, target),
        _present(
            "custom tags",
            {name: f"{count} times" for name, count in source.custom.items()},
            dict.fromkeys(target.custom, ""),
            "elements that the target's model holds",
        ),
        _transmissions(source, target),
        _present("safety controllers", source.safety, target.safety, "soft limits of joints"),
    ]
    return Conversion(source.name, target.name, target.engine, tuple(rows))


def configurations(
    source: Description, *dynamics: Dynamics, count: int = POSES
) -> list[dict[str, float]]:
    """The state of zeros, and ``count`` drawn inside the limits, every mimic holding.

    Only joints that all of ``dynamics`` have are given a value.
    """
    shared = [name for name in source.dynamics.joints if all(name in d.joints for d in dynamics)]
    generator = np.random.default_rng(20240229)
    found: list[dict[str, float]] = [dict.fromkeys(shared, 0.0)]
    for _ in range(count):
        drawn = {}
        for name in shared:
            lower, upper = source.joints[name].range or (-_REACH, _REACH)
            lower, upper = max(lower, -_REACH), min(upper, _REACH)
            drawn[name] = float(generator.uniform(min(lower, upper), max(lower, upper)))
        for name in shared:
            drawn[name] = _followed(source.mimics, drawn, name)
        found.append(drawn)
    return found


def _followed(
    mimics: Mapping[str, tuple[str, float, float]], drawn: Mapping[str, float], name: str
) -> float:
    if name not in mimics:
        return drawn[name]
    leader, multiplier, offset = mimics[name]
    if leader not in drawn:
        return drawn[name]
    return multiplier * _followed(mimics, drawn, leader) + offset


# -- what it does


def _behaviour(
    source: Description,
    target: Description,
    reference: Dynamics,
    by: str,
    poses: list[dict[str, float]],
) -> Iterable[Row]:
    ran = f"{by} against {target.engine} at {len(poses)} configurations"
    frames = [name for name in reference.frames if name in target.dynamics.frames]
    metres = radians = 0.0
    for q in poses:
        first, second = reference.poses(q), target.dynamics.poses(q)
        for frame in frames:
            metres = max(metres, float(np.abs(first[frame] - second[frame])[:3, 3].max()))
            radians = max(radians, turned(first[frame], second[frame]))
    what = f"{len(frames)} frames"
    yield _measured("forward kinematics, position", what, ran, metres, 1.0, "m")
    yield _measured("forward kinematics, orientation", what, ran, radians, 1.0, "rad")
    yield _directions(source, target, reference, by)
    mass = reference.mass(), target.dynamics.mass()
    yield _measured(
        "mass",
        f"{mass[0]:.9g} kg",
        f"{by} against {target.engine}, all bodies",
        abs(mass[0] - mass[1]),
        max(mass[0], 1e-3),
        "kg",
        after=f"{mass[1]:.9g} kg",
    )
    centre = max(
        float(np.abs(reference.center_of_mass(q) - target.dynamics.center_of_mass(q)).max())
        for q in poses
    )
    yield _measured("centre of mass", "of all bodies", ran, centre, 1.0, "m")
    mine, theirs = _orders(reference, target.dynamics, poses[0])
    names = f"{len(mine)} joints"
    torque, largest = 0.0, 1.0
    matrix, heaviest = 0.0, 1e-3
    for q in poses if mine else []:
        one, two = reference.gravity_torque(q)[mine], target.dynamics.gravity_torque(q)[theirs]
        torque, largest = max(torque, _most(one - two)), max(largest, _most(one))
        big = reference.mass_matrix(q)[np.ix_(mine, mine)]
        other = target.dynamics.mass_matrix(q)[np.ix_(theirs, theirs)]
        matrix, heaviest = max(matrix, _most(big - other)), max(heaviest, _most(big))
    yield _measured("gravity torque", names, ran, torque, largest, "N*m or N")
    yield _measured("mass matrix", names, ran, matrix, heaviest, "kg*m^2, kg*m or kg")
    yield _default_state(source, target)


def turned(first: Vector, second: Vector) -> float:
    """Angle between two rotations, exact where it is small, rad."""
    chord = float(np.linalg.norm(first[:3, :3] - second[:3, :3])) / math.sqrt(8.0)
    return 2.0 * math.asin(min(1.0, chord))


def _most(values: Vector) -> float:
    return float(np.abs(values).max()) if values.size else 0.0


def _orders(
    first: Dynamics, second: Dynamics, shared: Mapping[str, float]
) -> tuple[list[int], list[int]]:
    """Where the shared joints stand in the two orders."""
    return (
        [first.joints.index(name) for name in shared],
        [second.joints.index(name) for name in shared],
    )


def _measured(
    feature: str,
    before: str,
    ran: str,
    difference: float,
    scale: float,
    unit: str,
    *,
    after: str | None = None,
    items: tuple[Item, ...] = (),
) -> Row:
    verdict: Verdict = "kept" if difference <= EXACT * scale else "changed"
    told = after or before
    if verdict == "changed" and after is None:
        told = f"{before}, off by up to {difference:.3g} {unit}"
    # What is not a number is no smaller than the tolerance either.
    critical = not difference <= SINGLE * scale
    if not math.isfinite(difference):
        verdict, critical = "changed", True
    return Row(
        feature, verdict, before, told, ran, difference, EXACT * scale, unit, items, critical
    )


def _directions(source: Description, target: Description, reference: Dynamics, by: str) -> Row:
    """Each joint moved alone from the state of zeros: the screw that it makes the robot follow."""
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
            angle = math.pi if second is None else _between(first, second)
            break
        worst = max(worst, angle)
        if angle > SINGLE:
            turned_round = "the other way" if angle > math.pi / 2 else "about another axis"
            items.append(Item(name, "changed", "as stated", f"{turned_round}, {angle:.4g} rad"))
    ran = f"each joint moved by {_STEP:g} rad or m alone, {by} against {target.engine}"
    return _measured(
        "direction of every joint",
        f"{len(shared)} joints",
        ran,
        worst,
        1.0,
        "rad",
        items=tuple(items),
    )


def _screw(motion: Vector) -> Vector | None:
    """Unit direction of a motion: of its rotation, else of its translation; None if it rests."""
    skew = motion[:3, :3] - motion[:3, :3].T
    axis = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        axis = motion[:3, 3]
        length = float(np.linalg.norm(axis))
    return None if length < _PARALLEL else axis / length


def _between(first: Vector, second: Vector) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(first, second))), float(first @ second))


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
        worst,
        1.0,
        "rad or m",
        items=tuple(items),
    )


# -- what it holds


def _table(
    feature: str,
    before: str,
    after: str,
    comparison: str,
    items: list[Item],
    *,
    empty: bool = False,
    critical: bool = False,
    lost: bool = False,
) -> Row:
    """A row of named things: kept where no item stands out."""
    verdict: Verdict = "kept"
    if empty:
        verdict = "none"
    elif lost or any(item.verdict == "lost" for item in items):
        verdict = "lost"
    elif items:
        verdict = "changed"
    return Row(
        feature,
        verdict,
        before,
        after,
        comparison,
        items=tuple(items[:_MOST_ITEMS]),
        critical=critical,
    )


def _links(source: Description, target: Description) -> Row:
    """Mass, centre and inertia, body by body; what that does as a whole is measured elsewhere."""
    massive = {name for name, link in source.links.items() if link.mass or link.inertia.any()}
    items = []
    for name in sorted(massive | set(target.links)):
        before, after = source.links.get(name), target.links.get(name)
        if before is None or after is None:
            if name in massive:
                items.append(Item(name, "lost", f"{source.links[name].mass:.6g} kg", None))
            continue
        scale = max(before.mass, 1e-3)
        apart = {
            "mass": (abs(before.mass - after.mass), scale, before.mass, after.mass, "kg"),
            "centre of mass": (
                _most(before.com - after.com) if before.mass else 0.0,
                1.0,
                before.com,
                after.com,
                "m",
            ),
            "inertia": (
                _most(before.inertia - after.inertia),
                max(_most(before.inertia), 1e-6),
                np.linalg.eigvalsh(before.inertia),
                np.linalg.eigvalsh(after.inertia),
                "kg*m^2",
            ),
        }
        for what, (difference, size, old, new, unit) in apart.items():
            if difference > EXACT * size:
                told = (f"{what} {_numbers(value)} {unit}" for value in (old, new))
                items.append(Item(name, "changed", *told))
    return _table(
        "links",
        f"{len(source.links)} links, {len(massive)} with mass",
        f"{len(target.links)} bodies",
        "mass, centre of mass and principal inertia of each body",
        items,
        critical=bool(items) and _moved_away(source, target),
    )


def _moved_away(source: Description, target: Description) -> bool:
    """Whether a group of links that are fixed to each other is another body than before.

    A conversion may merge such links: then no motion can tell.
    """
    if not target.links:
        return False
    tree = source.dynamics
    assert isinstance(tree, RigidTree)
    head: dict[str, str] = {}
    for name, body in tree.bodies.items():
        fixed = body.joint is None and body.parent is not None
        head[name] = head[body.parent] if fixed and body.parent is not None else name
    poses = tree.poses({})
    groups: dict[str, list[str]] = {}
    for name, first in head.items():
        groups.setdefault(first, []).append(name)
    for first, names in groups.items():
        back = inverse(poses[first])
        before, after = (
            sum(
                (
                    _moments(held.links[name], back @ poses[name])
                    for name in names
                    if name in held.links
                ),
                np.zeros((4, 4)),
            )
            for held in (source, target)
        )
        if _most(before - after) > SINGLE * max(_most(before), 1e-3):
            return True
    return False


def _moments(link: LinkFacts, pose: Vector) -> Vector:
    """(4, 4) pseudo-inertia in another frame: it adds up over bodies (Wensing et al., 2018)."""
    second = np.trace(link.inertia) / 2 * np.eye(3) - link.inertia
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = second + link.mass * np.outer(link.com, link.com)
    matrix[:3, 3] = matrix[3, :3] = link.mass * link.com
    matrix[3, 3] = link.mass
    moved: Vector = pose @ matrix @ pose.T
    return moved


def _numbers(values: Any) -> str:
    return " ".join(f"{float(value):.6g}" for value in np.ravel(np.asarray(values)))


def _joints(source: Description, target: Description) -> Row:
    items = []
    for name, facts in source.joints.items():
        if name not in target.joints:
            like = [other for other in target.joints if other.startswith(f"{name}_")]
            if facts.kind in ("planar", "free") and like:
                items.append(Item(name, "changed", facts.kind, " ".join(like)))
            elif facts.kind == "free":
                items.append(Item(name, "changed", "free", "a body that no joint holds"))
            else:
                items.append(Item(name, "lost", facts.kind, None))
        elif target.joints[name].kind != facts.kind:
            items.append(Item(name, "changed", facts.kind, target.joints[name].kind))
    return _table(
        "joints that move",
        f"{len(source.joints)}",
        f"{len(target.joints)}",
        "kind of each joint of the compiled model",
        items,
        empty=not source.joints,
        critical=any(item.verdict == "lost" for item in items),
    )


def _independent(source: Description, target: Description) -> Row:
    verdict: Verdict = "kept" if source.independent == target.independent else "changed"
    return Row(
        "independent degrees of freedom",
        verdict,
        str(source.independent),
        str(target.independent),
        "degrees of freedom less the rank of the couplings between them",
    )


def _passive(source: Description, target: Description) -> Row:
    items = [
        Item(name, "changed", "driven", "passive")
        for name in sorted((target.passive - source.passive) & set(source.joints))
    ] + [
        Item(name, "changed", "passive", "driven")
        for name in sorted((source.passive - target.passive) & set(target.joints))
    ]
    return _table(
        "passive joints",
        _some(source.passive),
        _some(target.passive),
        "joints that no actuator and no mimic moves",
        items,
        empty=not source.passive and not target.passive,
    )


def _actuators(source: Description, target: Description) -> Row:
    items = []
    held = {joint: (gear, bound) for joint, gear, bound in target.actuators.values()}
    for joint, gear, bound in source.actuators.values():
        if joint not in held:
            items.append(Item(joint, "lost", _actuator(gear, bound), None))
        elif not _alike(bound, held[joint][1]) or abs(held[joint][0] - gear) > EXACT:
            items.append(Item(joint, "changed", _actuator(gear, bound), _actuator(*held[joint])))
    return _table(
        "actuators",
        f"{len(source.actuators)} driven joints",
        f"{len(target.actuators)} actuators",
        "joint, gear and force range of each actuator",
        items,
        empty=not source.actuators and not target.actuators,
    )


def _actuator(gear: float, bound: tuple[float, float] | None) -> str:
    words = "no bound" if bound is None else f"{bound[0]:g} to {bound[1]:g} N*m or N"
    return words if gear == 1.0 else f"{words}, gear {gear:g}"


def _limits(source: Description, target: Description) -> Iterable[Row]:
    readers: dict[str, tuple[Callable[[JointFacts], Any], str, str]] = {
        "position limits": (lambda facts: facts.range, "rad or m", "range of each joint"),
        "velocity limits": (lambda f: f.velocity, "rad/s or m/s", "greatest speed of each joint"),
        "effort limits": (
            lambda facts: facts.effort,
            "N*m or N",
            "force on each joint with every control driven past its bounds"
            if target.name == "MJCF"
            else "greatest force of each joint",
        ),
    }
    for feature, (read, unit, comparison) in readers.items():
        items = []
        stated = kept = 0
        worst = 0.0
        for name, facts in source.joints.items():
            if name not in target.joints:
                continue
            before, after = read(facts), read(target.joints[name])
            stated += before is not None
            kept += after is not None
            if before is not None and after is not None:
                worst = max(worst, _most(np.subtract(before, after)))
            if _alike(before, after):
                continue
            verdict: Verdict = "lost" if after is None else "changed"
            items.append(Item(name, verdict, _value(before, unit), _value(after, unit)))
        row = _table(
            feature,
            f"{stated} stated",
            f"{kept} held",
            comparison,
            items,
            empty=not stated and not kept,
        )
        yield Row(
            row.feature,
            row.verdict,
            row.before,
            row.after,
            row.comparison,
            worst,
            EXACT,
            unit,
            row.items,
        )


def _alike(before: Any, after: Any) -> bool:
    if before is None or after is None:
        return before is after
    return bool(np.allclose(before, after, rtol=EXACT, atol=EXACT))


def _value(value: Any, unit: str) -> str | None:
    return None if value is None else f"{_numbers(value)} {unit}"


def _passive_terms(source: Description, target: Description) -> Row:
    items = []
    stated = 0
    for name, facts in source.joints.items():
        held = target.joints.get(name)
        for what in ("damping", "friction"):
            before = float(getattr(facts, what))
            stated += before != 0.0
            if held is None:
                continue
            after = float(getattr(held, what))
            if not _alike(before, after):
                verdict: Verdict = "lost" if after == 0.0 else "changed"
                items.append(Item(f"{name} {what}", verdict, f"{before:g}", f"{after:g}"))
    return _table(
        "damping and friction",
        f"{stated} stated",
        f"{stated - sum(item.verdict == 'lost' for item in items)} held",
        "coefficients of each joint of the compiled model",
        items,
        empty=not stated and not items,
    )


def _named(
    feature: str, before: Mapping[str, str], after: Mapping[str, str], comparison: str
) -> Row:
    items = [
        Item(name, "lost" if name not in after else "changed", before.get(name), after.get(name))
        for name in sorted(set(before) | set(after))
        if before.get(name) != after.get(name)
    ]
    return _table(
        feature, _some(before), _some(after), comparison, items, empty=not before and not after
    )


def _present(
    feature: str, before: Mapping[str, str], after: Mapping[str, str], comparison: str
) -> Row:
    """What the source states and the target has, or has not, whatever it is made of."""
    items = [Item(name, "lost", before[name], None) for name in sorted(before) if name not in after]
    return _table(feature, _some(before), _some(after), comparison, items, empty=not before)


def _sensors(source: Description, target: Description) -> Row:
    items = []
    for name, kind in source.sensors.items():
        held = target.sensors.get(name)
        if held is None:
            items.append(Item(name, "lost", kind, None))
        elif held == "site":
            items.append(Item(name, "changed", kind, "a site: its place, and no signal"))
    kept = sum(name in target.sensors for name in source.sensors)
    return _table(
        "sensors",
        _some(source.sensors),
        f"{kept} places",
        "sites of the compiled model, and the sensors on them",
        items,
        empty=not source.sensors,
    )


def _mimics(source: Description, target: Description) -> Row:
    items = []
    for name, law in source.mimics.items():
        held = target.mimics.get(name)
        if held is None:
            items.append(Item(name, "lost", _law(law), "independent"))
        elif held[0] != law[0] or not np.allclose(held[1:], law[1:], rtol=SINGLE, atol=SINGLE):
            items.append(Item(name, "changed", _law(law), _law(held)))
    comparison = (
        "residual of each constraint with its leader moved by 1 rad or m"
        if target.name == "MJCF"
        else "follower, leader, multiplier and offset in the model"
    )
    return _table(
        "mimic",
        _some(source.mimics),
        _some(target.mimics),
        comparison,
        items,
        empty=not source.mimics and not target.mimics,
        critical=any(item.verdict == "changed" for item in items),
    )


def _law(law: tuple[str, float, float]) -> str:
    return f"{law[1]:g} * {law[0]} + {law[2]:g}"


def _constraints(source: Description, target: Description) -> Row:
    before, after = list(source.constraints), list(target.constraints)
    items = [Item(word, "lost", word, None) for word in before if word not in after]
    items += [Item(word, "changed", None, word) for word in after if word not in before]
    return _table(
        "tendons and constraints",
        _some(before),
        _some(after),
        "constraints of the compiled model, mimics apart",
        items,
        empty=not before and not after,
    )


def _shapes(source: Description, target: Description) -> Row:
    items = []
    for link in sorted(set(source.shapes) | set(target.shapes)):
        before, after = source.shapes.get(link, ()), target.shapes.get(link, ())
        if len(before) != len(after):
            verdict: Verdict = "lost" if len(after) < len(before) else "changed"
            told = ("; ".join(map(str, held)) or None for held in (before, after))
            items.append(Item(link, verdict, *told))
            continue
        for one, two in zip(before, after, strict=True):
            size = max(1.0, _most(one.upper - one.lower))
            if one.kind != two.kind or one.apart(two) > CLOSE * size:
                items.append(Item(link, "changed", str(one), str(two)))
    count = sum(map(len, source.shapes.values())), sum(map(len, target.shapes.values()))
    return _table(
        "collision shapes",
        str(count[0]),
        str(count[1]),
        f"kind of each shape and the box that holds it in its link, to {CLOSE:g} m",
        items,
        empty=not any(count),
    )


def _disabled(source: Description, target: Description) -> Row:
    fresh = target.disabled_pairs - source.disabled_pairs
    gone = source.disabled_pairs - target.disabled_pairs
    items = [Item(_pair(pair), "lost", "kept apart", None) for pair in sorted(map(sorted, gone))]
    items += [
        Item(_pair(pair), "changed", "not said", "kept apart")
        for pair in sorted(map(sorted, fresh))
    ]
    return _table(
        "disabled pairs",
        f"{len(source.disabled_pairs)} (a URDF names none)",
        f"{len(target.disabled_pairs)} kept apart",
        "pairs of bodies with shapes that the engine's rules never let collide",
        items,
        empty=not source.disabled_pairs and not target.disabled_pairs,
    )


def _pair(pair: Iterable[str]) -> str:
    return " and ".join(pair)


def _contact(source: Description, target: Description) -> Row:
    stated = {name: f"{count} times" for name, count in source.contact.items()}
    held = {name: f"{count} shapes" for name, count in target.contact.items()}
    items = [Item(name, "lost", value, None) for name, value in stated.items()]
    if not stated:
        items = [
            Item(name, "changed", "not stated", f"{value}, the engine's default")
            for name, value in held.items()
        ]
    return _table(
        "contact materials",
        _some(stated),
        _some(held),
        "friction of each shape that collides",
        items,
        empty=not stated and not held,
    )


def _frames(source: Description, target: Description) -> Row:
    missing = sorted(set(source.dynamics.frames) - set(target.dynamics.frames))
    items = [Item(name, "lost", "a frame", None) for name in missing]
    count = len(source.dynamics.frames)
    return _table(
        "frames",
        str(count),
        str(count - len(missing)),
        "every frame asked for its pose",
        items,
        critical=bool(missing),
    )


def _transmissions(source: Description, target: Description) -> Row:
    items = []
    for joint, words in source.transmissions.items():
        if joint not in target.transmissions:
            items.append(Item(joint, "lost", words, None))
        elif _reduction(words) != _reduction(target.transmissions[joint]):
            items.append(Item(joint, "changed", words, target.transmissions[joint]))
    return _table(
        "transmissions",
        _some(source.transmissions),
        f"{len(target.transmissions)} gears",
        "gear of the actuator on each joint",
        items,
        empty=not source.transmissions,
    )


def _reduction(words: str) -> float:
    _, _, number = words.partition("reduction ")
    try:
        return float(number)
    except ValueError:
        return 1.0


def _some(names: Iterable[str]) -> str:
    listed = sorted(names)
    if not listed:
        return "none"
    shown = ", ".join(listed[:4]) + (", ..." if len(listed) > 4 else "")
    return f"{len(listed)}: {shown}"
