"""Describe a URDF by its text."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pytest_twin.asset import stated_elements
from pytest_twin.asset.loss import shapes
from pytest_twin.asset.loss.description import Description, JointFacts, LinkFacts
from pytest_twin.asset.loss.shapes import Shape
from pytest_twin.realization import urdf_tree
from pytest_twin.realization.node import Node
from pytest_twin.realization.urdf import Robot, origin
from pytest_twin.realization.urdf_extras import Extras

Vector = NDArray[np.float64]

_KINDS = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide", "floating": "free"}


def describe(robot: Robot, extras: Extras, meshes: Mapping[str, Vector]) -> Description:
    """Describe a URDF.

    Args:
        extras: transmissions, sensors, contact and custom tags of its file.
        meshes: file name of a collision mesh, as written -> (n, 3) unscaled vertices, m.
    """
    joints = {
        joint.name: JointFacts(
            _KINDS.get(joint.type, joint.type),
            joint.limits,
            joint.velocity,
            joint.effort,
            joint.damping,
            joint.friction,
        )
        for joint in robot.in_order()
        if joint.type != "fixed"
    }
    mimics = {
        joint.name: (joint.mimic.joint, joint.mimic.multiplier, joint.mimic.offset)
        for joint in robot.joints.values()
        if joint.mimic is not None and joint.type != "fixed"
    }
    transmissions = {
        made.joint: " ".join(
            word
            for word in (
                made.type.rpartition("/")[2],
                "" if made.reduction is None else f"reduction {made.reduction:g}",
            )
            if word
        )
        for made in extras.transmissions
    }
    driven = {
        name: (name, 1.0, None if not facts.effort else (-facts.effort, facts.effort))
        for name, facts in joints.items()
        if name not in mimics and (facts.effort or name in transmissions)
    }
    degrees = {"free": 6, "planar": 3}
    return Description(
        name="URDF",
        engine="its own text",
        dynamics=urdf_tree.build(robot),
        links={
            link.name: LinkFacts(link.mass, link.com, link.inertia) for link in robot.links.values()
        },
        joints=joints,
        independent=sum(degrees.get(facts.kind, 1) for facts in joints.values()) - len(mimics),
        actuators=driven,
        mimics=mimics,
        shapes={
            link.name: found
            for link in robot.links.values()
            if (found := _shapes(link.node, meshes))
        },
        contact=extras.contact,
        sensors={sensor.name: sensor.type for sensor in extras.sensors},
        transmissions=transmissions,
        safety={
            joint.name: " ".join(f"{key}={value}" for key, value in node.attributes.items())
            for joint in robot.joints.values()
            if (node := joint.node.find("safety_controller")) is not None
        },
        custom=extras.custom,
        stated=stated_elements.rows(robot.node) | _idle_ranges(robot),
    )


def _idle_ranges(robot: Robot) -> dict[str, dict[str, str]]:
    """Return ranges of continuous joints, which no engine applies and no realization preserves."""
    found = {}
    for joint in robot.joints.values():
        limit = joint.node.find("limit")
        if joint.type == "continuous" and limit is not None:
            ends = {
                key: limit.attributes[key] for key in ("lower", "upper") if key in limit.attributes
            }
            if ends:
                found[joint.name] = " ".join(f"{key}={value} rad" for key, value in ends.items())
    return {"ranges of continuous joints": found} if found else {}


def _shapes(link: Node, meshes: Mapping[str, Vector]) -> tuple[Shape, ...]:
    found = []
    for collision in link.all("collision"):
        geometry = collision.find("geometry")
        pose = np.eye(4)
        pose[:3, 3], pose[:3, :3] = origin(collision)
        for shape in [] if geometry is None else geometry.children:
            if shape.tag == "mesh":
                points = meshes[shape.attributes.get("filename", "")]
                scale = shape.numbers("scale", (1.0, 1.0, 1.0))
                found.append(shapes.of_points("mesh", points * scale, pose))
            elif shape.tag == "box":
                found.append(shapes.of_box(shape.numbers("size", None, size=3), pose))
            elif shape.tag == "sphere":
                found.append(shapes.of_sphere(shape.number("radius", None), pose))
            elif shape.tag in ("cylinder", "capsule"):
                radius, length = shape.number("radius", None), shape.number("length", None)
                found.append(shapes.of_round(shape.tag, radius, length, pose))
    return shapes.in_order(found)
