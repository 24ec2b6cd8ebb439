"""A calibration in the files of other tools: tf lines, easy_handeye2, a URDF with the estimates."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from lxml import etree
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.closed_form import rigid
from pytest_twin.calibration.plan import Plan, load_plan
from pytest_twin.formats import xml
from pytest_twin.metrics.pose import rotation_of

STATIC_TRANSFORMS = "static_transforms.sh"
EASY_HANDEYE = "easy_handeye2.calib"
URDF = "calibrated.urdf"

_DIGITS = 9
"""Digits after the point of an exported m or rad: a nanometre."""


def export_files(plan: str, document: Mapping[str, Any], folder: str) -> dict[str, str]:
    """File name -> text of every export of an accepted calibration; empty for any other.

    Args:
        plan: path of the plan.
        document: content of ``calibration.json``.
        folder: where the files will lie.
    """
    if document["verdict"] != "accepted":
        return {}
    found = load_plan(Path(plan))
    records = document["records"]
    texts = {}
    lines = list(static_transforms(records))
    if lines:
        texts[STATIC_TRANSFORMS] = "#!/bin/sh\n" + "\n".join(lines) + "\n"
    if "hand_eye" in records:
        texts[EASY_HANDEYE] = easy_handeye(found, document)
    changes = {"joint_zeros", "geometry", "hand_eye", "tcp"} & set(records)
    if found.robot is not None and found.robot.suffix.lower() == ".urdf" and changes:
        texts[URDF] = calibrated_urdf(found.robot, records, Path(folder))
    return texts


def static_transforms(records: Mapping[str, Any]) -> Iterator[str]:
    """A ``static_transform_publisher`` command of ROS 2 for each transform."""
    seen = set()
    for record in records.values():
        transform = record.get("transform")
        if transform is None or transform["quaternion_wxyz"] is None:
            continue
        frames = record["parent"], record["child"]
        if frames in seen or frames[::-1] in seen:
            # base_world and robot_world are one transform and its inverse.
            continue
        seen.add(frames)
        x, y, z = transform["xyz"]
        w, a, b, c = transform["quaternion_wxyz"]
        numbers = {"x": x, "y": y, "z": z, "qx": a, "qy": b, "qz": c, "qw": w}
        yield " ".join(
            [
                "ros2 run tf2_ros static_transform_publisher",
                *(f"--{name} {value:.{_DIGITS}f}" for name, value in numbers.items()),
                f"--frame-id {shlex.quote(frames[0])}",
                f"--child-frame-id {shlex.quote(frames[1])}",
            ]
        )


def easy_handeye(plan: Plan, document: Mapping[str, Any]) -> str:
    """The text of easy_handeye2's calibration file."""
    record = document["records"]["hand_eye"]
    on_hand = plan.mount == "hand"
    base = next(
        (
            one["child"] if name == "base_world" else one["parent"]
            for name, one in document["records"].items()
            if name in ("base_world", "robot_world", "target")
        ),
        "base",
    )
    x, y, z = record["transform"]["xyz"]
    w, a, b, c = record["transform"]["quaternion_wxyz"]
    content = {
        "parameters": {
            "name": plan.id,
            "calibration_type": "eye_in_hand" if on_hand else "eye_on_base",
            "robot_base_frame": base if on_hand else record["parent"],
            "robot_effector_frame": plan.flange,
            "tracking_base_frame": record["child"],
            "tracking_marker_frame": "target",
            "freehand_robot_movement": True,
            "move_group_namespace": "/",
            "move_group": "manipulator",
        },
        "transform": {
            "translation": {"x": x, "y": y, "z": z},
            "rotation": {"x": a, "y": b, "z": c, "w": w},
        },
    }
    return yaml.safe_dump(content, sort_keys=False)


def calibrated_urdf(robot: Path, records: Mapping[str, Any], folder: Path) -> str:
    """A URDF's text with joint zeros and link geometry in its joints' origins, and new frames.

    Args:
        robot: the URDF before calibration.
        records: of ``calibration.json``.
        folder: where the text will lie; relative paths of meshes are rewritten for it.
    """
    root = xml.parse(robot)
    changes: dict[str, FloatArray] = {}
    for name, change in _joint_changes(records, root):
        changes[name] = changes.get(name, np.eye(4)) @ change
    for joint in root.iter("joint"):
        change_of = changes.get(joint.get("name", ""))
        if change_of is not None and joint.get("type") is not None:
            _set_origin(joint, _origin(joint) @ change_of)
    for name in ("hand_eye", "tcp"):
        record = records.get(name)
        if record is not None and record["transform"]["quaternion_wxyz"] is not None:
            _add_frame(root, record)
    for element in root.iter("mesh", "texture"):
        file = element.get("filename", "")
        if file and "://" not in file and not Path(file).is_absolute():
            element.set("filename", os.path.relpath(robot.parent / file, folder))
    etree.indent(root)
    return etree.tostring(root, encoding="unicode") + "\n"


def _joint_changes(records: Mapping[str, Any], root: Any) -> Iterator[tuple[str, FloatArray]]:
    """Deviations in each joint's own frame: offsets, then tilts, then the zero about its axis."""
    geometry = records.get("geometry", {"values": {}})["values"].values()
    for joint in dict.fromkeys(one["joint"] for one in geometry):
        mine = [one for one in geometry if one["joint"] == joint]
        offset, tilt = (
            np.sum(
                [np.array(one["direction"]) * one["value"] for one in mine if one["kind"] == kind]
                or [np.zeros(3)],
                axis=0,
            )
            for kind in ("translation", "rotation")
        )
        yield joint, rigid(Rotation.from_rotvec(tilt).as_matrix(), offset)
    axes = {joint.get("name"): joint for joint in root.iter("joint")}
    for joint, one in records.get("joint_zeros", {"values": {}})["values"].items():
        element = axes.get(joint)
        if element is None:
            continue
        stated = element.find("axis")
        text = "1 0 0" if stated is None else stated.get("xyz", "1 0 0")
        axis = np.array([float(word) for word in text.split()])
        axis = axis / np.linalg.norm(axis) * one["value"]
        if element.get("type") == "prismatic":
            yield joint, rigid(np.eye(3), axis)
        else:
            yield joint, rigid(Rotation.from_rotvec(axis).as_matrix(), np.zeros(3))


def _origin(joint: Any) -> FloatArray:
    element = joint.find("origin")
    if element is None:
        return np.eye(4)
    xyz, rpy = (
        [float(word) for word in element.get(name, "0 0 0").split()] for name in ("xyz", "rpy")
    )
    return rigid(Rotation.from_euler("xyz", rpy).as_matrix(), np.array(xyz))


def _set_origin(joint: Any, transform: FloatArray) -> None:
    element = joint.find("origin")
    if element is None:
        element = etree.SubElement(joint, "origin")
    rpy = Rotation.from_matrix(transform[:3, :3]).as_euler("xyz")
    element.set("xyz", " ".join(f"{value:.{_DIGITS + 3}g}" for value in transform[:3, 3]))
    element.set("rpy", " ".join(f"{value:.{_DIGITS + 3}g}" for value in rpy))


def _add_frame(root: Any, record: Mapping[str, Any]) -> None:
    """A link of the record's child frame, fixed to its parent, where the robot has none yet."""
    links = {link.get("name") for link in root.iter("link")}
    if record["child"] in links or record["parent"] not in links:
        return
    etree.SubElement(root, "link", name=record["child"])
    joint = etree.SubElement(root, "joint", name=f"{record['child']}_joint", type="fixed")
    etree.SubElement(joint, "parent", link=record["parent"])
    etree.SubElement(joint, "child", link=record["child"])
    transform = record["transform"]
    _set_origin(joint, rigid(rotation_of(transform["quaternion_wxyz"]), transform["xyz"]))
