"""Strategy for random robots, each as URDF and as MJCF."""

from __future__ import annotations

import math
from typing import Literal

from hypothesis import strategies as st

from pytest_twin.strategies.drawn_robot import DrawnRobot
from pytest_twin.strategies.robot_elements import (
    MOVING,
    DrawnJoint,
    DrawnLink,
    DrawnShape,
    JointKind,
    Triple,
)

_KINDS: tuple[JointKind, ...] = ("revolute", "continuous", "prismatic", "fixed")
_UNIT_AXES: tuple[Triple, ...] = (
    *((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)),
    *((0.0, 0.0, -1.0), (0.0, -1.0, 0.0), (-1.0, 0.0, 0.0)),
)


def robots(
    *,
    links: tuple[int, int] = (2, 7),
    kinds: tuple[JointKind, ...] = _KINDS,
    mimics: bool = True,
    meshes: bool = True,
    branching: bool | None = None,
) -> st.SearchStrategy[DrawnRobot]:
    """Draw robots with a fixed base and a single tree.

    Each moving link has a mass and a consistent inertia; a link of a fixed joint may have none.
    Shapes are boxes, spheres, cylinders and small meshes.

    Args:
        links: smallest and largest number of links, 2 or more.
        kinds: types of joints in URDF.
        mimics: whether joints may follow others.
        meshes: whether collision shapes may be meshes (files next to the model).
        branching: True: a link may have several children; False: a serial chain; None: either.
    """
    return _robots(links=links, kinds=kinds, mimics=mimics, meshes=meshes, branching=branching)


def urdf_robots(**options: object) -> st.SearchStrategy[str]:
    """Draw the URDF text of random robots without mesh files; options as for :func:`robots`."""
    return robots(**{**options, "meshes": False}).map(lambda robot: robot.urdf)  # type: ignore[arg-type]


def mjcf_robots(**options: object) -> st.SearchStrategy[str]:
    """Draw the MJCF text of random robots without mesh files; options as for :func:`robots`."""
    return robots(**{**options, "meshes": False}).map(lambda robot: robot.mjcf)  # type: ignore[arg-type]


@st.composite
def _robots(
    draw: st.DrawFn,
    *,
    links: tuple[int, int],
    kinds: tuple[JointKind, ...],
    mimics: bool,
    meshes: bool,
    branching: bool | None,
) -> DrawnRobot:
    count = draw(st.integers(max(2, links[0]), links[1]))
    spread = draw(st.booleans()) if branching is None else branching
    joints: list[DrawnJoint] = []
    for i in range(1, count):
        parent = draw(st.integers(0, i - 1)) if spread else i - 1
        # The first joint is movable, so that the robot moves.
        choice = [kind for kind in kinds if kind in MOVING] if i == 1 else list(kinds)
        kind = draw(st.sampled_from(choice or list(kinds)))
        joints.append(draw(_joint(i, parent, kind)))
    if mimics:
        joints = draw(_with_mimics(joints))
    moved = {joint.child for joint in joints if joint.kind in MOVING}
    bodies = [
        draw(_link(f"link{i}", heavy=f"link{i}" in moved, meshes=meshes)) for i in range(count)
    ]
    return DrawnRobot("drawn", tuple(bodies), tuple(joints))


def _number(low: float, high: float) -> st.SearchStrategy[float]:
    """Uniform and short decimal numbers; Hypothesis draws plain floats mostly near 0."""
    scale = 10**6 if high - low < 16 else 10**4
    return st.integers(round(low * scale), round(high * scale)).map(lambda number: number / scale)


def _triple(reach: float) -> st.SearchStrategy[Triple]:
    return st.tuples(*(_number(-reach, reach) for _ in range(3)))


@st.composite
def _axis(draw: st.DrawFn) -> Triple:
    if draw(st.booleans()):
        return draw(st.sampled_from(_UNIT_AXES))
    x, y, z = draw(_triple(1.0).filter(lambda v: math.hypot(*v) > 0.3))
    length = math.hypot(x, y, z)
    return (x / length, y / length, z / length)


@st.composite
def _joint(draw: st.DrawFn, child: int, parent: int, kind: JointKind) -> DrawnJoint:
    limits = None
    reach = 0.4 if kind == "prismatic" else 3.0
    if kind in ("revolute", "prismatic"):
        limits = (-draw(_number(0.1 * reach, reach)), draw(_number(0.1 * reach, reach)))
    moving = kind in MOVING
    return DrawnJoint(
        name=f"joint{child}",
        kind=kind,
        parent=f"link{parent}",
        child=f"link{child}",
        position=draw(_triple(0.4)),
        rpy=draw(_triple(3.0)),
        axis=draw(_axis()),
        limits=limits,
        effort=draw(_number(1.0, 100.0)) if moving else None,
        velocity=draw(_number(0.5, 10.0)) if moving else None,
        damping=draw(_number(0.0, 2.0)) if moving else 0.0,
        friction=draw(_number(0.0, 0.5)) if moving else 0.0,
    )


@st.composite
def _with_mimics(draw: st.DrawFn, joints: list[DrawnJoint]) -> list[DrawnJoint]:
    """Let some joints follow an earlier one; their limits contain the range of the leader."""
    made: list[DrawnJoint] = []
    for joint in joints:
        leaders = [other for other in made if other.limits and other.mimic is None]
        if joint.limits and leaders and draw(st.integers(0, 3)) == 0:
            leader = draw(st.sampled_from(leaders))
            scale = draw(_number(0.25, 2.0)) * draw(st.sampled_from((1.0, -1.0)))
            offset = draw(_number(-0.1, 0.1))
            assert leader.limits is not None
            ends = sorted(scale * value + offset for value in leader.limits)
            joint = joint.following(leader.name, scale, offset, (ends[0] - 0.01, ends[1] + 0.01))
        made.append(joint)
    return made


@st.composite
def _link(draw: st.DrawFn, name: str, *, heavy: bool, meshes: bool) -> DrawnLink:
    if not heavy and draw(st.booleans()):
        return DrawnLink(name, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    mass = draw(_number(0.05, 10.0))
    a, b, c = (draw(_number(0.01, 0.15)) for _ in range(3))
    # Moments of a solid ellipsoid, which satisfy the triangle inequality with a margin.
    moments = (
        mass / 5 * (b * b + c * c),
        mass / 5 * (a * a + c * c),
        mass / 5 * (a * a + b * b),
    )
    held = draw(st.lists(_shape(name, meshes=meshes), max_size=2, unique_by=lambda s: s.kind))
    return DrawnLink(name, mass, draw(_triple(0.2)), draw(_triple(3.0)), moments, tuple(held))


@st.composite
def _shape(draw: st.DrawFn, link: str, *, meshes: bool) -> DrawnShape:
    kinds: list[Literal["box", "sphere", "cylinder", "mesh"]] = ["box", "sphere", "cylinder"]
    kind = draw(st.sampled_from([*kinds, "mesh"] if meshes else kinds))
    count = {"box": 3, "sphere": 1, "cylinder": 2, "mesh": 3}[kind]
    size = tuple(draw(_number(0.01, 0.3)) for _ in range(count))
    return DrawnShape(kind, size, draw(_triple(0.2)), draw(_triple(3.0)), f"{link}.stl")
