"""Write joint zeros, link geometry and new sites into an MJCF."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from lxml import etree
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.joint_changes import joint_changes
from pytest_twin.formats import xml
from pytest_twin.formats.xml import digits
from pytest_twin.metrics.pose import inverse, quaternion_of, rigid, rotation_of
from pytest_twin.realization.loading import load

_FOLDERS = ("meshdir", "texturedir", "assetdir")


def write_calibrated_mjcf(robot: Path, records: Mapping[str, Any], folder: Path) -> str | None:
    """Return the text of an MJCF with a frame around each body that holds its joint's deviation.

    Everything else stays unchanged: defaults, classes, includes. Returns None if a frame cannot
    express the change: the joint is not the first of its body, or the body is inside a frame or in
    an included file.

    Args:
        robot: the MJCF before calibration.
        records: ``records`` of ``calibration.json``.
        folder: folder of the new file; references to other files are rewritten for it.

    Raises:
        TwinError: the model cannot be loaded.
    """
    root = xml.parse(robot)
    model = load(robot).model
    axes = {
        model.joint(at).name: (
            np.array(model.jnt_axis[at]),
            model.jnt_type[at] == mujoco.mjtJoint.mjJNT_SLIDE,
        )
        for at in range(model.njnt)
    }
    changes: dict[str, FloatArray] = {}
    for name, change in joint_changes(records, axes):
        changes[name] = changes.get(name, np.eye(4)) @ change
    bodies = {body.get("name", ""): body for body in root.iter("body")}
    for name, change in changes.items():
        joint = model.joint(name).id
        at = int(model.jnt_bodyid[joint])
        element = bodies.get(model.body(at).name)
        parent = None if element is None else element.getparent()
        if (
            element is None
            or parent is None
            or parent.tag == "frame"
            or model.body_jntadr[at] != joint
        ):
            return None
        body = rigid(rotation_of(model.body_quat[at]), model.body_pos[at])
        # A joint's frame is that at position 0; the file states the body's pose at the reference
        # position.
        back = -float(model.qpos0[model.jnt_qposadr[joint]]) * axes[name][0]
        anchor = rigid(np.eye(3), model.jnt_pos[joint]) @ (
            rigid(np.eye(3), back)
            if axes[name][1]
            else rigid(Rotation.from_rotvec(back).as_matrix(), np.zeros(3))
        )
        moved = body @ anchor @ change @ inverse(anchor) @ inverse(body)
        frame = etree.Element("frame", pos=digits(moved[:3, 3]), quat=_turn(moved))
        parent.replace(element, frame)
        frame.append(element)
    for name in ("hand_eye", "tcp"):
        record = records.get(name)
        if record is not None and record["transform"]["quaternion_wxyz"] is not None:
            _add_site(root, bodies, record)
    _relocate(root, robot.parent, folder)
    etree.indent(root)
    return etree.tostring(root, encoding="unicode") + "\n"


def _add_site(root: Any, bodies: Mapping[str, Any], record: Mapping[str, Any]) -> None:
    """Add a site for the record's child frame to its parent body, unless it exists."""
    taken = {site.get("name") for site in root.iter("site")}
    body = bodies.get(record["parent"])
    if body is None or record["child"] in taken:
        return
    transform = record["transform"]
    etree.SubElement(
        body, "site", name=record["child"], pos=digits(transform["xyz"]),
        quat=digits(transform["quaternion_wxyz"]),
    )  # fmt: skip


def _relocate(root: Any, before: Path, after: Path) -> None:
    """Rewrite the folders of assets and included files relative to the new file."""

    def moved(reference: str) -> str:
        path = Path(reference)
        return reference if path.is_absolute() else os.path.relpath(before / path, after)

    for element in root.iter("include"):
        element.set("file", moved(element.get("file", "")))
    compilers = list(root.iter("compiler"))
    if any(element.get("file") for element in root.iter("mesh", "texture", "hfield", "skin")):
        compilers = compilers or [etree.SubElement(root, "compiler")]
    for element in compilers[:1]:
        if element.get("assetdir") is None:
            for name in ("meshdir", "texturedir"):
                element.set(name, element.get(name, "."))
    for element in compilers:
        for name in _FOLDERS:
            if element.get(name) is not None:
                element.set(name, moved(element.get(name)))


def _turn(pose: FloatArray) -> str:
    return digits(quaternion_of(pose[:3, :3]))
