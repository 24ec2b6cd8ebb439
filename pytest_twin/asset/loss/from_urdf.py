"""What a URDF says, by its own text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pytest_twin.asset.loss import shapes
from pytest_twin.asset.loss.description import Description, JointFacts, LinkFacts
from pytest_twin.asset.loss.shapes import Shape
from pytest_twin.realization import urdf_tree
from pytest_twin.realization.node import Node
from pytest_twin.realization.urdf import Robot, origin

Vector = NDArray[np.float64]

_KNOWN = frozenset({"link", "joint", "material", "transmission", "sensor"})
_KINDS = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide", "floating": "free"}
_CONTACT = ("mu1", "mu2", "mu", "kp", "kd", "lateral_friction", "rolling_friction", "stiffness")


def describe(robot: Robot, meshes: Mapping[str, Vector]) -> Description:
    """Everything that the text states.

    Args:
        meshes: reference of a collision mesh, as written -> its vertices (n, 3), not scaled, m.
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
    transmissions = _transmissions(robot.node)
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
        contact=_contact(robot.node),
        sensors=_sensors(robot.node),
        transmissions=transmissions,
        safety={
            joint.name: " ".join(f"{key}={value}" for key, value in node.attributes.items())
            for joint in robot.joints.values()
            if (node := joint.node.find("safety_controller")) is not None
        },
        custom=Counter(child.tag for child in robot.node.children if child.tag not in _KNOWN),
    )


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


def _transmissions(root: Node) -> dict[str, str]:
    found = {}
    for node in root.walk():
        if node.tag != "transmission":
            continue
        reduction = next(
            (
                inner.attributes.get("value") or ""
                for inner in node.walk()
                if inner.tag == "mechanicalReduction"
            ),
            "",
        )
        for joint in node.walk():
            if joint.tag == "joint" and joint.attributes.get("name"):
                kind = node.attributes.get("type", "") or _text_of(node, "type")
                found[joint.attributes["name"]] = (
                    " ".join(
                        word
                        for word in (kind, f"reduction {reduction}" if reduction else "")
                        if word
                    )
                    or "transmission"
                )
    return found


def _text_of(node: Node, tag: str) -> str:
    child = node.find(tag)
    return "" if child is None else child.attributes.get("value", "")


def _contact(root: Node) -> dict[str, int]:
    return dict(Counter(node.tag for node in root.walk() if node.tag in _CONTACT))


def _sensors(root: Node) -> dict[str, str]:
    found = {}
    for node in root.walk():
        if node.tag == "sensor":
            name = node.attributes.get("name") or f"sensor at line {node.line}"
            found[name] = node.attributes.get("type", "sensor")
    return found
