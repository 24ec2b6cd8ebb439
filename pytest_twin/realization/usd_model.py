"""A USD stage as an MJCF of the same bodies, joints and drives: names, units and dependencies.

Checks find joints and frames in it, and the dependency map its parts. It has no shapes and is not
what is stepped: Newton steps the stage itself (:mod:`pytest_twin.realization.newton`).
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import ModelError
from pytest_twin.realization.tree import TreeBody
from pytest_twin.realization.usd_read import UsdJoint, UsdRobot, read

Vector = NDArray[np.float64]
_RATE = 500.0
"""1/s; steps of a stage that states none: MuJoCo's default timestep of 2 ms."""


def as_mjcf(path: Path) -> bytes:
    """The MJCF of a stage.

    Its timestep is that of the stage's ``newton:timeStepsPerSecond``. A joint has the drive that
    the stage states, else a motor. Damping is integrated explicitly, as Newton does.

    Raises:
        UsdMissingError: the extra ``usd`` is not installed.
        ModelError: no stage, a stage without links, or a joint that a tree cannot have.
    """
    robot = read(path)
    by_parent: dict[str | None, list[TreeBody]] = {}
    for body in robot.tree.bodies.values():
        by_parent.setdefault(body.parent, []).append(body)
    moved = {body.joint.name for body in robot.tree.bodies.values() if body.joint is not None}
    for name, joint in robot.joints.items():
        if name not in moved and joint.kind != "fixed":
            raise ModelError(
                f"joint {name!r} of the stage is {joint.kind}",
                path=path,
                expected="revolute, prismatic and fixed joints, one for each link",
            )
    joints = [robot.joints[name] for name in robot.tree.joints]
    lines = [
        "<mujoco>",
        '<compiler angle="radian" autolimits="true"/>',
        f'<option timestep="{1.0 / _rate(path):.17g}">',
        '<flag eulerdamp="disable"/>',
        "</option>",
        "<worldbody>",
        *(line for body in by_parent[None] for line in _body(body, by_parent, robot)),
        "</worldbody>",
        "<actuator>",
        *(_drive(joint) for joint in joints),
        "</actuator>",
        "<equality>",
        *(
            f"<joint joint1={quoteattr(follower)} joint2={quoteattr(leader)} "
            f'polycoef="{_text([offset, multiplier, 0.0, 0.0, 0.0])}"/>'
            for follower, (leader, multiplier, offset) in robot.mimics.items()
        ),
        "</equality>",
        "</mujoco>",
    ]
    return "\n".join(lines).encode()


def _rate(path: Path) -> float:
    from pxr import Usd

    stage = Usd.Stage.Open(str(path))
    for prim in stage.Traverse():
        attribute: Any = prim.GetAttribute("newton:timeStepsPerSecond")
        if attribute and (attribute.Get() or 0) > 0:
            return float(attribute.Get())
    return _RATE


def _body(
    body: TreeBody, by_parent: dict[str | None, list[TreeBody]], robot: UsdRobot
) -> Iterable[str]:
    yield f"<body name={quoteattr(body.name)} {_pose(body.placement)}>"
    if body.joint is not None:
        anchor = body.joint.anchor
        yield _joint(
            robot.joints[body.joint.name],
            f'type="{body.joint.kind}" pos="{_text(anchor[:3, 3])}" '
            f'axis="{_text(anchor[:3, :3] @ body.joint.axis)}"',
        )
    if body.mass > 0.0:
        tensor = body.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        yield (
            f'<inertial pos="{_text(body.com)}" mass="{body.mass:.17g}" '
            f'fullinertia="{_text(tensor)}"/>'
        )
    for child in by_parent.get(body.name, ()):
        yield from _body(child, by_parent, robot)
    yield "</body>"


def _joint(joint: UsdJoint, place: str) -> str:
    limits = "" if joint.limits is None else f' range="{_text(joint.limits)}"'
    return (
        f"<joint name={quoteattr(joint.name)} {place}{limits} "
        f'damping="{joint.damping or 0.0:.17g}" frictionloss="{joint.friction or 0.0:.17g}"/>'
    )


def _drive(joint: UsdJoint) -> str:
    names = f"name={quoteattr(joint.name)} joint={quoteattr(joint.name)}"
    force = joint.max_force
    if force is not None and np.isfinite(force):
        names += f' forcerange="{_text([-force, force])}"'
    if joint.stiffness:
        return f'<position {names} kp="{joint.stiffness:.17g}" kv="{joint.drive_damping:.17g}"/>'
    if joint.drive_damping:
        return f'<velocity {names} kv="{joint.drive_damping:.17g}"/>'
    return f"<motor {names}/>"


def _pose(pose: Vector) -> str:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return f'pos="{_text(pose[:3, 3])}" quat="{_text([w, x, y, z])}"'


def _text(values: Iterable[float]) -> str:
    return " ".join(f"{float(value):.17g}" for value in values)
