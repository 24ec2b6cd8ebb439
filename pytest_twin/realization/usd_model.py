"""A USD stage as an MJCF of the same bodies, joints and drives: names, units and dependencies.

Checks find joints and frames in it, and the dependency map its parts. It has no shapes and is not
what is stepped: Newton steps the stage itself (:mod:`pytest_twin.realization.newton`).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree

from pytest_twin.errors import ModelError
from pytest_twin.formats.xml import digits
from pytest_twin.metrics.pose import pose_vector
from pytest_twin.realization.inertia import six_components
from pytest_twin.realization.tree import TreeBody, TreeJoint
from pytest_twin.realization.usd_read import UsdJoint, UsdRobot, read

_TIMESTEP = 0.002
"""Timestep of a stage that states none, s: MuJoCo's default."""


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
    root = etree.Element("mujoco")
    etree.SubElement(root, "compiler", angle="radian", autolimits="true")
    timestep = _TIMESTEP if robot.timestep is None else robot.timestep
    option = etree.SubElement(root, "option", timestep=digits([timestep]))
    etree.SubElement(option, "flag", eulerdamp="disable")
    _add_bodies(etree.SubElement(root, "worldbody"), None, by_parent, robot)
    actuators = etree.SubElement(root, "actuator")
    for name in robot.tree.joints:
        _add_drive(actuators, robot.joints[name])
    equalities = etree.SubElement(root, "equality")
    for follower, (leader, multiplier, offset) in robot.mimics.items():
        polynomial = digits([offset, multiplier, 0.0, 0.0, 0.0])
        etree.SubElement(equalities, "joint", joint1=follower, joint2=leader, polycoef=polynomial)
    return bytes(etree.tostring(root))


def _add_bodies(
    above: Any, parent: str | None, by_parent: Mapping[str | None, list[TreeBody]], robot: UsdRobot
) -> None:
    """Add the bodies whose parent is ``parent``, with all bodies below them."""
    for body in by_parent.get(parent, ()):
        place = pose_vector(body.placement)
        made = etree.SubElement(
            above, "body", name=body.name, pos=digits(place[:3]), quat=digits(place[3:])
        )
        if body.joint is not None:
            _add_joint(made, body.joint, robot.joints[body.joint.name])
        if body.mass > 0.0:
            etree.SubElement(
                made,
                "inertial",
                pos=digits(body.com),
                mass=digits([body.mass]),
                fullinertia=digits(six_components(body.inertia)),
            )
        _add_bodies(made, body.name, by_parent, robot)


def _add_joint(body: Any, degree: TreeJoint, joint: UsdJoint) -> None:
    made = etree.SubElement(
        body,
        "joint",
        name=joint.name,
        type=degree.kind,
        pos=digits(degree.anchor[:3, 3]),
        axis=digits(degree.anchor[:3, :3] @ degree.axis),
        damping=digits([joint.damping or 0.0]),
        frictionloss=digits([joint.friction or 0.0]),
    )
    if joint.limits is not None:
        made.set("range", digits(joint.limits))


def _add_drive(actuators: Any, joint: UsdJoint) -> None:
    if joint.stiffness:
        kind = "position"
        gains = {"kp": digits([joint.stiffness]), "kv": digits([joint.drive_damping])}
    elif joint.drive_damping:
        kind, gains = "velocity", {"kv": digits([joint.drive_damping])}
    else:
        kind, gains = "motor", {}
    made = etree.SubElement(actuators, kind, {"name": joint.name, "joint": joint.name, **gains})
    force = joint.max_force
    if force is not None and np.isfinite(force):
        made.set("forcerange", digits([-force, force]))
