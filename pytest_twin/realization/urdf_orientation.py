"""State the orientations of a URDF as ``rpy``: since version 1.1 they may be quaternions.

The rules are those of urdfdom: an ``origin`` of a joint, an inertial, a visual or a collision has
``rpy`` or ``quat_xyzw``, never both. A robot without ``version="1.1"`` or higher has ``rpy`` only;
its quaternions are ignored.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.formats import xml
from pytest_twin.realization.node import Node

QUATERNION = "quat_xyzw"
_FIRST_VERSION = (1, 1)
_ORIGINS = ("joint/origin", "link/inertial/origin", "link/visual/origin", "link/collision/origin")
_UNIT_LENGTH = 1e-3
"""Largest deviation of the length from 1 that rounding explains."""


@dataclass(frozen=True, slots=True)
class StatedQuaternion:
    """A quaternion that was restated as ``rpy``.

    Attributes:
        origin: the ``origin`` element, which now has ``rpy``.
        quaternion: the text of ``quat_xyzw``.
        rpy: the text of ``rpy``, rad.
    """

    origin: Any
    quaternion: str
    rpy: str


def parse(path: Path) -> tuple[xml.Element, list[StatedQuaternion]]:
    """Parse a URDF and restate its quaternions.

    Returns:
        The root element, and the quaternions that were restated.

    Raises:
        FormatError: not well-formed, or larger than a limit.
        ModelError: no quaternion of a rotation, or an ``rpy`` beside it.
    """
    root = xml.parse(path)
    if root.tag != "robot" or not has_quaternions(root.get("version")):
        return root, []
    return root, [
        _restate(origin, path)
        for at in _ORIGINS
        for origin in root.findall(at)
        if QUATERNION in origin.attrib
    ]


def has_quaternions(version: str | None) -> bool:
    """Whether a robot of this ``version`` may have quaternions."""
    try:
        major, minor = (int(part) for part in (version or "").split("."))
    except ValueError:
        return False
    return (major, minor) >= _FIRST_VERSION


def ignored(robot: Node) -> list[Node]:
    """The ``origin`` elements whose quaternion has no effect, in a robot of an earlier version."""
    if has_quaternions(robot.attributes.get("version")):
        return []
    return [node for node in robot.walk() if node.tag == "origin" and QUATERNION in node.attributes]


def _restate(origin: Any, path: Path) -> StatedQuaternion:
    text = str(origin.get(QUATERNION))
    owner = next(origin.iterancestors("joint", "link"))
    label = f"{owner.tag} '{owner.get('name')}'.origin"
    node = Node(label, dict(origin.attrib), path, origin.sourceline or 1)
    if "rpy" in origin.attrib:
        raise node.error(
            "two orientations of one origin, rpy and quat_xyzw",
            value=f'rpy="{origin.get("rpy")}" quat_xyzw="{text}"',
            expected="one of the two; remove the other",
        )
    quaternion = node.numbers(QUATERNION, None, size=4)
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > _UNIT_LENGTH:
        raise node.error(
            "no quaternion of a rotation",
            QUATERNION,
            value=f"length {length:.6g} of {text}",
            expected="a unit quaternion x y z w, such as 0 0 0 1",
        )
    # Few robots have quaternions, and the import takes longer than that of MuJoCo.
    from scipy.spatial.transform import Rotation

    angles = _roll_pitch_yaw(Rotation.from_quat(quaternion).as_matrix())
    rpy = " ".join(repr(float(angle)) for angle in angles)
    del origin.attrib[QUATERNION]
    origin.set("rpy", rpy)
    return StatedQuaternion(origin, text, rpy)


def _roll_pitch_yaw(matrix: FloatArray) -> tuple[float, float, float]:
    """Angles about fixed axes [rad] of a (3, 3) rotation matrix.

    Near a pitch of 90 degrees roll and yaw are one angle. The roll is taken from what yaw and pitch
    leave of the rotation, so that the rounding of the yaw cancels.
    """
    yaw = math.atan2(matrix[1, 0], matrix[0, 0])
    sine, cosine = math.sin(yaw), math.cos(yaw)
    pitch = math.atan2(-matrix[2, 0], cosine * matrix[0, 0] + sine * matrix[1, 0])
    roll = math.atan2(
        sine * matrix[0, 2] - cosine * matrix[1, 2], cosine * matrix[1, 1] - sine * matrix[0, 1]
    )
    return roll, pitch, yaw
