"""Propose specs of kind ``contact``: on what stands in the scene, and on the robot's own links."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pytest_twin.checks import proposals
from pytest_twin.checks.base import Check, NothingToProposeError
from pytest_twin.checks.contact_scene import FLOOR, OBJECT
from pytest_twin.errors import TwinError

if TYPE_CHECKING:
    from pytest_twin.realization import Realization

_MASS = 0.2  # kg, of the object
_LOAD = 1.962  # N, its weight; it is pressed as hard where it has none
_MOST_FRICTION = 4.0  # largest coefficient at which the ball on a link slips
_FRICTION_ROUNDING = 1e-9
_MOST_BESIDE = 8  # surfaces of equal parameters beside which a ball is tried; each takes 0.1 to 1 s
_START = 0.03  # m, from the bounding sphere of a link to the centre of a ball beside it
_BALL: Mapping[str, Any] = {"shape": "sphere", "size": [0.02], "mass": f"{_MASS:g} kg"}
_ON_A_LINK: Mapping[str, Any] = {
    "duration": "0.3 s",
    "gravity": False,
    "press": f"{_LOAD:g} N",
    "others": "locked",
}

Spec = dict[str, Any]


@dataclass(frozen=True, slots=True)
class _Surface:
    """A geom of a link that can be touched.

    Attributes:
        name: name of the geom; of its link, if the geom has none.
        center: (3,) in the link's frame, m.
        radius: radius of its bounding sphere, m.
    """

    name: str
    body: str
    center: tuple[float, ...]
    radius: float
    friction: float


def first_specs(check: Check, realization: Realization) -> list[Mapping[str, Any]]:
    """Return specs that run on this robot.

    - On what stands in the scene: an object is released on it and pushed over it. A free robot
      without surroundings is released above a floor.
    - On the robot: a ball is pushed over a link until it slips, over one link of each set of
      contact parameters. The link alone determines the friction of this contact; between a foot
      and a floor MuJoCo takes the greater coefficient, so that the foot's may have no effect.
    - Where nothing else runs, a ball is pressed on the last link that it touches.

    Raises:
        NothingToProposeError: no body is touched.
    """
    pose = {"pose": proposals.first_pose(realization)}
    links = _links(realization)
    specs: list[Mapping[str, Any]] = []
    for choices in _on_surroundings(realization, pose, links):
        specs += _first_that_runs(check, realization, choices)
    for number, alike in enumerate(_alike(realization, links)):
        for spec in _first_that_runs(
            check, realization, _slides_over(alike, pose), friction=alike[0].friction
        ):
            # Two unnamed geoms of one link have the name of the link.
            is_taken = any(spec["name"] == other["name"] for other in specs)
            specs.append({**spec, "name": f"{spec['name']}_{number}"} if is_taken else spec)
    if not specs:
        specs = _first_that_runs(check, realization, (_press_on(link, pose) for link in links))
    if not specs:
        raise NothingToProposeError(
            "no body of the robot is touched at its pose by a ball, a box or a floor"
        )
    return specs


def _first_that_runs(
    check: Check, realization: Realization, choices: Iterable[Spec], friction: float | None = None
) -> list[Mapping[str, Any]]:
    for spec in choices:
        if _runs(check, spec, realization, friction):
            return [spec]
    return []


def _runs(check: Check, spec: Spec, realization: Realization, friction: float | None) -> bool:
    """Whether a spec brings the pair into contact and gives all numbers to compare.

    Args:
        friction: coefficient of the geom that the object should touch; None for any.
    """
    trial = proposals.draft(check, realization, spec)
    try:
        values = check.observe(trial, realization, lambda _: None).values
    except TwinError:
        return False
    load, compared = values["normal_force"], spec["tolerance"]
    if not values["onset_time"] > 0.0:
        return False
    if "normal_force" in compared and (load is None or abs(load - _LOAD) >= 0.02 * _LOAD):
        return False
    if friction is None:
        return True
    return (
        values["friction"] is not None
        and values["penetration"] is not None
        and abs(values["declared_friction"] - friction) <= _FRICTION_ROUNDING
    )


def _links(realization: Realization) -> list[str]:
    """Moving bodies that can be touched, those at the ends first: feet, fingers and flanges."""
    structure = realization.structure
    moving = structure.body_tree.keys() & structure.collision_bodies
    return [body for body in reversed(realization.names("body")) if body in moving]


def _on_surroundings(
    realization: Realization, pose: Mapping[str, Any], links: list[str]
) -> list[list[Spec]]:
    """Return first specs with what stands in the scene, each as variants at different places."""
    structure = realization.structure
    # The robot and its base are not a support for objects.
    robot = {b for body in structure.body_tree for b in structure.ancestors(body)}
    furniture = structure.collision_bodies.intersection(realization.names("body")) - robot
    named = [geom for geom, body in structure.geom_body.items() if body in furniture]
    standing = [*named, *sorted(furniture - {"world", *(structure.geom_body[g] for g in named)})]
    if standing:
        return _on_furniture(standing[:3], pose)
    if "free" in structure.joint_type.values():
        return [[_fall(body, pose) for body in links]]
    return []


def _on_furniture(standing: list[str], pose: Mapping[str, Any]) -> list[list[Spec]]:
    box = {"shape": "box", "size": [0.02, 0.02, 0.02], "mass": f"{_MASS:g} kg"}
    rest = {"onset_time": "5 ms", "penetration": "0.1 mm", "normal_force": "0.1 N"}
    push = {"direction": [1.0, 0.0, 0.0], "force": f"{2.0 * _LOAD:.3g} N", "duration": "0.5 s"}
    targets: list[Spec] = [
        {"pair": [OBJECT, base], "object": {**box, "offset": [x, y, 0.0]}}
        for base in standing
        for x, y in ((0.0, 0.0), (0.3, 0.0), (0.0, 0.3), (-0.3, 0.0))
    ]
    release: list[Spec] = [
        {
            "name": f"release_{target['pair'][1]}",
            "title": f"A box let go above {target['pair'][1]}",
            "target": {"primitive": "release", **target},
            "stimulus": {"duration": "1.5 s", "gap": "20 mm", "others": "locked", **pose},
            "tolerance": {**rest, "position": "1 mm", "rebound": "1 mm", "restitution": "5 %"},
        }
        for target in targets
    ]
    slide: list[Spec] = [
        {
            "name": f"slide_{target['pair'][1]}",
            "title": f"A box pushed over {target['pair'][1]}",
            "target": {"primitive": "slide", **target},
            "stimulus": {
                "duration": "0.5 s", "gap": "1 mm", "slide": push, "others": "locked", **pose
            },
            "tolerance": {**rest, "friction": "2 %", "slip_force": "0.1 N"},
        }
        for target in targets
    ]  # fmt: skip
    return [release, slide]


def _fall(body: str, pose: Mapping[str, Any]) -> Spec:
    return {
        "name": f"release_{body}",
        "title": f"The robot let go above a floor, {body} first",
        "target": {"primitive": "release", "pair": [body, FLOOR], "floor": -5.0},
        "stimulus": {"duration": "0.3 s", "gap": "20 mm", **pose},
        "tolerance": {"onset_time": "5 ms", "position": "1 mm", "orientation": "5 mrad"},
    }


def _slides_over(alike: list[_Surface], pose: Mapping[str, Any]) -> Iterator[Spec]:
    """Yield variants: the ball starts above each surface, then below and beside it."""
    yield from (_slide_over(surface, pose, {}) for surface in alike)
    for axis, sign in ((2, -1.0), (1, 1.0), (1, -1.0), (0, 1.0), (0, -1.0)):
        for surface in alike[:_MOST_BESIDE]:
            offset = list(surface.center)
            offset[axis] += sign * (surface.radius + _START)
            yield _slide_over(surface, pose, {"frame": surface.body, "offset": offset})


def _slide_over(surface: _Surface, pose: Mapping[str, Any], start: Mapping[str, Any]) -> Spec:
    push = {
        "direction": [1.0, 0.2, 0.1],  # along no axis, so that part of it is along any surface
        "force": f"{_MOST_FRICTION * _LOAD:.4g} N",
        "duration": "0.5 s",
    }
    return {
        "name": f"slide_over_{surface.name}",
        "title": f"A ball pressed on {surface.name} and pushed until it slips",
        "target": {
            "primitive": "slide",
            "pair": [OBJECT, surface.name],
            "object": {**_BALL, **start},
        },
        "stimulus": {**_ON_A_LINK, "slide": push, **pose},
        "tolerance": {
            "onset_time": "5 ms",
            "position": "1 mm",
            "penetration": "0.1 mm",
            "friction": "2 %",
        },
    }


def _press_on(body: str, pose: Mapping[str, Any]) -> Spec:
    return {
        "name": f"approach_{body}",
        "title": f"A ball pressed on {body}",
        "target": {"primitive": "approach", "pair": [OBJECT, body], "object": _BALL},
        "stimulus": {**_ON_A_LINK, **pose},
        "tolerance": {"onset_time": "5 ms", "position": "1 mm"},
    }


def _alike(realization: Realization, links: list[str]) -> list[list[_Surface]]:
    """Return the surfaces on which a ball slips, in groups of equal contact parameters."""
    from pytest_twin.realization.features.elements import colliding_geoms

    model, geom_body = realization.model, realization.structure.geom_body
    can_collide = colliding_geoms(model)
    groups: dict[tuple[float, ...], list[_Surface]] = {}
    for link in links:
        body = model.body(link).id
        for geom in range(model.ngeom):
            friction = float(model.geom_friction[geom, 0])
            slips = model.geom_condim[geom] > 1 and friction < _MOST_FRICTION
            if model.geom_bodyid[geom] != body or not can_collide[geom] or not slips:
                continue
            name = model.geom(geom).name
            surface = _Surface(
                name if geom_body.get(name) == link else link,
                link,
                tuple(float(value) for value in model.geom_pos[geom]),
                float(model.geom_rbound[geom]),
                friction,
            )
            parameters = (
                float(model.geom_condim[geom]),
                *map(float, model.geom_friction[geom]),
                *map(float, model.geom_solref[geom]),
                *map(float, model.geom_solimp[geom]),
            )
            groups.setdefault(parameters, []).append(surface)
    return list(groups.values())
