"""Build a rigid-body tree from a URDF, without a physics engine."""

from __future__ import annotations

import numpy as np

from pytest_twin.realization.tree import RigidTree, TreeBody, TreeJoint
from pytest_twin.realization.urdf import Joint, Robot

SCALAR = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide"}
"""Type of a URDF joint with one degree of freedom -> ``hinge`` or ``slide``."""


def build(robot: Robot) -> RigidTree:
    """Build the tree; planar and floating joints stay at their initial pose."""
    bodies = [_body(robot, robot.root, None)]
    bodies += [_body(robot, joint.child, joint) for joint in robot.in_order()]
    return RigidTree(bodies)


def _body(robot: Robot, name: str, joint: Joint | None) -> TreeBody:
    link = robot.links[name]
    placement = np.eye(4)
    moved = None
    if joint is not None:
        placement[:3, :3], placement[:3, 3] = joint.rotation, joint.position
        if joint.type in SCALAR:
            kind = "slide" if joint.type == "prismatic" else "hinge"
            moved = TreeJoint(joint.name, kind, joint.axis, np.eye(4))  # type: ignore[arg-type]
    return TreeBody(
        name,
        None if joint is None else joint.parent,
        placement,
        moved,
        link.mass,
        link.com,
        link.inertia,
    )
