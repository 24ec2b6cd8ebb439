"""Describe a USD stage with UsdPhysics."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from pytest_twin.asset.loss import shapes
from pytest_twin.asset.loss.description import Description, JointFacts, LinkFacts
from pytest_twin.asset.loss.shapes import Shape
from pytest_twin.realization import usd, usd_read

_KINDS = {"revolute": "hinge", "prismatic": "slide"}


def describe(path: Path, floating: Iterable[str] = ()) -> Description:
    """Describe the robot of a stage.

    Args:
        floating: links without a joint that move freely in the source.
    """
    robot = usd_read.read(path)
    joints = {
        joint.name: JointFacts(
            _KINDS.get(joint.kind, joint.kind),
            joint.limits,
            joint.velocity,
            joint.max_force,
            joint.damping or 0.0,
            joint.friction or 0.0,
        )
        for joint in robot.joints.values()
        if joint.kind != "fixed"
    }
    degrees = {"spherical": 3, "d6": 3}
    free = 6 * len(list(floating))
    return Description(
        name="USD",
        engine=usd.version(),
        dynamics=robot.tree,
        links={
            name: LinkFacts(body.mass, body.com, body.inertia)
            for name, body in robot.tree.bodies.items()
            if name in robot.rigid_bodies
        },
        joints=joints,
        independent=free
        + sum(degrees.get(facts.kind, 1) for facts in joints.values())
        - len(robot.mimics),
        actuators={
            joint.name: (joint.name, 1.0, (-joint.max_force, joint.max_force))
            for joint in robot.joints.values()
            if joint.max_force is not None
        },
        mimics=robot.mimics,
        shapes={
            link: shapes.in_order([_shape(shape) for shape in held])
            for link, held in robot.collisions.items()
        },
        disabled_pairs=robot.disabled_pairs,
        contact={"physics material": robot.materials} if robot.materials else {},
        custom=dict.fromkeys(sorted(robot.attributes), 1),
    )


def _shape(shape: usd_read.UsdShape) -> Shape:
    if shape.kind == "box":
        return shapes.of_box(shape.size, shape.pose)
    if shape.kind == "sphere":
        return shapes.of_sphere(float(shape.size[0]), shape.pose)
    if shape.kind in ("cylinder", "capsule"):
        return shapes.of_round(shape.kind, float(shape.size[0]), float(shape.size[1]), shape.pose)
    return shapes.of_points(shape.kind, shape.points, shape.pose)
