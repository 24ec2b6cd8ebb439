"""Read transmissions, sensors and contact parameters of a URDF, and count other elements.

URDF defines few of these elements. This module reads those of ros_control, Gazebo and the draft of
URDF sensors. It counts all other elements, so that their loss is reported.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.formats import xml
from pytest_twin.realization.urdf import Robot, rotation

Vector = NDArray[np.float64]
_CONTACT = ("mu1", "mu2", "kp", "kd", "maxVel", "minDepth", "lateral_friction", "rolling_friction")
_KNOWN = ("link", "joint", "material", "transmission", "sensor")


@dataclass(frozen=True, slots=True)
class Transmission:
    """An actuator of a joint.

    Attributes:
        name, joint, type: as written.
        reduction: gear ratio, turns of the motor per turn of the joint; negative for opposite
            directions; None where not stated.
        line: line in the file.
    """

    name: str
    joint: str
    type: str
    reduction: float | None
    line: int


@dataclass(frozen=True, slots=True)
class Sensor:
    """A sensor on a link.

    Attributes:
        type: as written, such as ``imu``, ``ray``, ``force_torque``.
        pose: (4, 4) pose in the link, m.
        line: line in the file.
    """

    name: str
    type: str
    link: str
    pose: Vector
    line: int


@dataclass(frozen=True, slots=True)
class Extras:
    """Elements of a URDF other than links and joints.

    Attributes:
        transmissions: all transmissions.
        sensors: all sensors on links.
        contact: name of a contact parameter -> number of occurrences.
        custom: tag below ``robot`` that URDF does not define -> number of occurrences.
    """

    transmissions: tuple[Transmission, ...]
    sensors: tuple[Sensor, ...]
    contact: Mapping[str, int]
    custom: Mapping[str, int]


def read(robot: Robot) -> Extras:
    """Read the elements from the robot's file."""
    root: Any = xml.parse(robot.node.path)
    return Extras(
        tuple(found for node in root.iter("transmission") for found in _transmissions(node)),
        _sensors(root, robot),
        Counter(str(node.tag) for node in root.iter(*_CONTACT)),
        Counter(str(child.tag) for child in root if child.tag not in _KNOWN),
    )


def _transmissions(node: Any) -> list[Transmission]:
    kind = node.get("type") or _text(node.find("type"))
    reduction = _number(_text(next(node.iter("mechanicalReduction"), None)))
    return [
        Transmission(node.get("name", ""), joint.get("name"), kind, reduction, node.sourceline or 1)
        for joint in node.iter("joint")
        if joint.get("name")
    ]


def _sensors(root: Any, robot: Robot) -> tuple[Sensor, ...]:
    found: list[Sensor] = []
    taken: Counter[str] = Counter()
    for node in root.iter("sensor"):
        link = _link(node, robot)
        if link is None:
            continue
        name = node.get("name") or f"{link}_sensor"
        taken[name] += 1
        if taken[name] > 1:
            name = f"{name}_{taken[name]}"
        kind = node.get("type") or next((str(child.tag) for child in node), "sensor")
        found.append(Sensor(name, kind, link, _pose(node), node.sourceline or 1))
    return tuple(found)


def _link(node: Any, robot: Robot) -> str | None:
    """The link of a sensor, from its ``parent`` element or its enclosing ``gazebo`` block."""
    parent = node.find("parent")
    named = parent.get("link") if parent is not None else None
    for above in node.iterancestors("gazebo"):
        named = named or above.get("reference")
    if named in robot.joints:
        named = robot.joints[named].child
    return named if named in robot.links else None


def _pose(node: Any) -> Vector:
    """(4, 4) pose [m] from ``<pose>x y z roll pitch yaw</pose>`` or ``<origin xyz= rpy=>``."""
    origin = node.find("origin")
    words = _text(node.find("pose")).split()
    if origin is not None:
        words = origin.get("xyz", "0 0 0").split() + origin.get("rpy", "0 0 0").split()
    numbers = [_number(word) for word in words]
    pose = np.eye(4)
    values = [number for number in numbers if number is not None]
    if len(values) == 6:
        pose[:3, 3], pose[:3, :3] = values[:3], rotation(np.array(values[3:]))
    return pose


def _text(node: Any) -> str:
    return "" if node is None else (node.text or "").strip()


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) and abs(value) < 1e10 else None
