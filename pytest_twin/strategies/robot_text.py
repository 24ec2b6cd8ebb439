"""Write random robots as URDF and MJCF."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from lxml import etree

from pytest_twin.formats.xml import digits
from pytest_twin.metrics.pose import quaternion_of
from pytest_twin.realization.urdf import rotation
from pytest_twin.strategies.robot_elements import DrawnJoint, DrawnLink, DrawnShape, Triple

_Element = Any


def urdf(name: str, links: Sequence[DrawnLink], joints: Sequence[DrawnJoint]) -> str:
    """URDF of a robot with full precision; ``links[0]`` is its base."""
    root = etree.Element("robot", name=name)
    for link in links:
        _urdf_link(root, link)
    for joint in joints:
        _urdf_joint(root, joint)
    return _text(root)


def mjcf(name: str, links: Sequence[DrawnLink], joints: Sequence[DrawnJoint]) -> str:
    """MJCF of a robot with full precision; ``links[0]`` is its base."""
    root = etree.Element("mujoco", model=name)
    etree.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    asset = etree.SubElement(root, "asset")
    world = etree.SubElement(root, "worldbody")
    bodies: dict[str, _Element] = {}
    carried = {joint.child: joint for joint in joints}
    for link in links:
        joint = carried.get(link.name)
        above = world if joint is None else bodies[joint.parent]
        bodies[link.name] = _mjcf_body(above, asset, link, joint)
    equality = etree.SubElement(root, "equality")
    actuator = etree.SubElement(root, "actuator")
    for joint in joints:
        if joint.mimic is not None:
            leader, multiplier, offset = joint.mimic
            etree.SubElement(
                equality,
                "joint",
                name=f"{joint.name}_mimic",
                joint1=joint.name,
                joint2=leader,
                polycoef=digits([offset, multiplier, 0.0, 0.0, 0.0]),
            )
        elif joint.effort:
            bound = digits([-joint.effort, joint.effort])
            etree.SubElement(
                actuator,
                "motor",
                name=joint.name,
                joint=joint.name,
                ctrlrange=bound,
                forcerange=bound,
            )
    return _text(root)


def wedge(size: tuple[float, ...]) -> bytes:
    """Binary STL of a wedge: a box of ``size`` (3,) [m] with one edge cut off."""
    x, y, z = (value / 2 for value in size)
    points = np.array(
        [(-x, -y, -z), (x, -y, -z), (x, y, -z), (-x, y, -z), (-x, -y, z), (-x, y, z / 2)]
    )
    # Counter-clockwise seen from outside, so that the normals point outwards.
    faces = ((0, 2, 1), (0, 3, 2), (0, 1, 4), (1, 2, 5), (1, 5, 4), (2, 3, 5), (0, 4, 5), (0, 5, 3))
    data = bytearray(80) + struct.pack("<I", len(faces))
    for face in faces:
        a, b, c = (points[i] for i in face)
        normal = np.cross(b - a, c - a)
        normal = normal / np.linalg.norm(normal)
        data += struct.pack("<12fH", *normal, *a, *b, *c, 0)
    return bytes(data)


def _urdf_link(root: _Element, link: DrawnLink) -> None:
    element = etree.SubElement(root, "link", name=link.name)
    if link.mass > 0:
        inertial = etree.SubElement(element, "inertial")
        _origin(inertial, link.com, link.rpy)
        etree.SubElement(inertial, "mass", value=repr(link.mass))
        made = etree.SubElement(inertial, "inertia", ixy="0", ixz="0", iyz="0")
        for key, moment in zip(("ixx", "iyy", "izz"), link.moments, strict=True):
            made.set(key, repr(moment))
    for shape in link.shapes:
        collision = etree.SubElement(element, "collision")
        _origin(collision, shape.position, shape.rpy)
        geometry = etree.SubElement(collision, "geometry")
        if shape.kind == "mesh":
            etree.SubElement(geometry, "mesh", filename=shape.file)
        elif shape.kind == "box":
            etree.SubElement(geometry, "box", size=digits(shape.size))
        elif shape.kind == "sphere":
            etree.SubElement(geometry, "sphere", radius=repr(shape.size[0]))
        else:
            radius, length = map(repr, shape.size)
            etree.SubElement(geometry, "cylinder", radius=radius, length=length)


def _urdf_joint(root: _Element, joint: DrawnJoint) -> None:
    element = etree.SubElement(root, "joint", name=joint.name, type=joint.kind)
    etree.SubElement(element, "parent", link=joint.parent)
    etree.SubElement(element, "child", link=joint.child)
    _origin(element, joint.position, joint.rpy)
    if joint.kind == "fixed":
        return
    etree.SubElement(element, "axis", xyz=digits(joint.axis))
    limit = etree.SubElement(element, "limit")
    if joint.limits is not None:
        limit.set("lower", repr(joint.limits[0]))
        limit.set("upper", repr(joint.limits[1]))
    limit.set("effort", repr(joint.effort or 0.0))
    limit.set("velocity", repr(joint.velocity or 0.0))
    etree.SubElement(
        element, "dynamics", damping=repr(joint.damping), friction=repr(joint.friction)
    )
    if joint.mimic is not None:
        leader, multiplier, offset = joint.mimic
        etree.SubElement(
            element, "mimic", joint=leader, multiplier=repr(multiplier), offset=repr(offset)
        )


def _mjcf_body(
    above: _Element, asset: _Element, link: DrawnLink, joint: DrawnJoint | None
) -> _Element:
    body = etree.SubElement(above, "body", name=link.name)
    if joint is not None:
        body.set("pos", digits(joint.position))
        body.set("quat", _quaternion(joint.rpy))
    if joint is not None and joint.kind != "fixed":
        made = etree.SubElement(
            body,
            "joint",
            name=joint.name,
            type="slide" if joint.kind == "prismatic" else "hinge",
            axis=digits(joint.axis),
            damping=repr(joint.damping),
            frictionloss=repr(joint.friction),
        )
        if joint.limits is not None:
            made.set("range", digits(joint.limits))
        if joint.effort and joint.mimic is None:
            made.set("actuatorfrcrange", digits([-joint.effort, joint.effort]))
    if link.mass > 0:
        etree.SubElement(
            body,
            "inertial",
            pos=digits(link.com),
            quat=_quaternion(link.rpy),
            mass=repr(link.mass),
            diaginertia=digits(link.moments),
        )
    for shape in link.shapes:
        geom = etree.SubElement(body, "geom", type=shape.kind)
        geom.set("pos", digits(shape.position))
        geom.set("quat", _quaternion(shape.rpy))
        if shape.kind == "mesh":
            etree.SubElement(asset, "mesh", name=link.name, file=shape.file)
            geom.set("mesh", link.name)
        else:
            geom.set("size", digits(_half_size(shape)))
    return body


def _half_size(shape: DrawnShape) -> list[float]:
    if shape.kind == "box":
        return [value / 2 for value in shape.size]
    return [shape.size[0], *(value / 2 for value in shape.size[1:])]


def _origin(element: _Element, position: Triple, rpy: Triple) -> None:
    etree.SubElement(element, "origin", xyz=digits(position), rpy=digits(rpy))


def _quaternion(rpy: Triple) -> str:
    return digits(quaternion_of(rotation(np.array(rpy))))


def _text(root: _Element) -> str:
    etree.indent(root)
    return str(etree.tostring(root, encoding="unicode")) + "\n"
