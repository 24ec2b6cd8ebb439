"""Export a calibration for other tools: tf, easy_handeye2, camera_info, URDF and MJCF."""

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
from pytest_twin.calibration.exported_mjcf import write_calibrated_mjcf
from pytest_twin.calibration.joint_changes import joint_changes
from pytest_twin.calibration.plan import Plan, load_plan
from pytest_twin.metrics.pose import rigid, rotation_of
from pytest_twin.realization import urdf_orientation

STATIC_TRANSFORMS = "static_transforms.sh"
EASY_HANDEYE = "easy_handeye2.calib"
URDF = "calibrated.urdf"
MJCF = "calibrated.xml"
CAMERA_INFO = "camera_info.yaml"

_DIGITS = 9
"""Digits after the decimal point of exported values in m or rad (1 nm)."""


def export_files(plan: str, document: Mapping[str, Any], folder: str) -> dict[str, str]:
    """Return file name -> text of each export of an accepted calibration; empty for any other.

    Args:
        document: content of ``calibration.json``.
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
    if found.robot is not None and found.robot.suffix.lower() == ".xml" and changes:
        text = write_calibrated_mjcf(found.robot, records, Path(folder))
        if text is not None:
            texts[MJCF] = text
    if "intrinsics" in records and (text := camera_info(found, document)) is not None:
        texts[CAMERA_INFO] = text
    return texts


def camera_info(plan: Plan, document: Mapping[str, Any]) -> str | None:
    """Return the text of ROS' ``camera_info`` file; None if its models lack a non-zero term.

    The format is that of ``camera_calibration_parsers``. ``plumb_bob`` has k1 k2 p1 p2 k3,
    ``rational_polynomial`` also k4 k5 k6.
    """
    record = document["records"]["intrinsics"]
    size = next((one["size"] for one in document.get("images", {}).values()), None)
    distortion = [*map(float, record["distortion"]), *[0.0] * 8]
    if size is None or any(distortion[8:]):
        return None
    few = not any(distortion[5:8])
    (fx, _, cx), (_, fy, cy), _ = record["camera_matrix"]

    def table(rows: int, columns: int, data: list[float]) -> dict[str, Any]:
        return {"rows": rows, "cols": columns, "data": [float(value) for value in data]}

    content = {
        "image_width": int(size[0]),
        "image_height": int(size[1]),
        "camera_name": plan.id,
        "camera_matrix": table(3, 3, [fx, 0, cx, 0, fy, cy, 0, 0, 1]),
        "distortion_model": "plumb_bob" if few else "rational_polynomial",
        "distortion_coefficients": table(1, 5 if few else 8, distortion[: 5 if few else 8]),
        "rectification_matrix": table(3, 3, [1, 0, 0, 0, 1, 0, 0, 0, 1]),
        "projection_matrix": table(3, 4, [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]),
    }
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


def static_transforms(records: Mapping[str, Any]) -> Iterator[str]:
    """Yield a ``static_transform_publisher`` command of ROS 2 for each transform."""
    seen = set()
    for record in records.values():
        transform = record.get("transform")
        if transform is None or transform["quaternion_wxyz"] is None:
            continue
        frames = record["parent"], record["child"]
        if frames in seen or frames[::-1] in seen:
            # base_world is the inverse of robot_world.
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
    """Return the text of easy_handeye2's calibration file."""
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
    """Return a URDF's text with joint zeros and link geometry in the joint origins, and new frames.

    Args:
        robot: the URDF before calibration.
        records: ``records`` of ``calibration.json``.
        folder: folder of the new file; relative paths of meshes are rewritten for it.
    """
    root, _ = urdf_orientation.parse(robot)
    changes: dict[str, FloatArray] = {}
    for name, change in joint_changes(records, _axes_of_urdf(root)):
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


def _axes_of_urdf(root: Any) -> dict[str, tuple[FloatArray, bool]]:
    """Return joint -> its axis in its own frame, and whether it is prismatic."""
    found = {}
    for joint in root.iter("joint"):
        stated = joint.find("axis")
        text = "1 0 0" if stated is None else stated.get("xyz", "1 0 0")
        axis = np.array([float(word) for word in text.split()])
        found[joint.get("name", "")] = axis, joint.get("type") == "prismatic"
    return found


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
    """Add a link for the record's child frame, fixed to its parent, unless it exists."""
    links = {link.get("name") for link in root.iter("link")}
    if record["child"] in links or record["parent"] not in links:
        return
    etree.SubElement(root, "link", name=record["child"])
    joint = etree.SubElement(root, "joint", name=f"{record['child']}_joint", type="fixed")
    etree.SubElement(joint, "parent", link=record["parent"])
    etree.SubElement(joint, "child", link=record["child"])
    transform = record["transform"]
    _set_origin(joint, rigid(rotation_of(transform["quaternion_wxyz"]), transform["xyz"]))
