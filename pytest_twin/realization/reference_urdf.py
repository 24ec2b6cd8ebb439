"""Build a Pinocchio model of a URDF with Pinocchio's own parser."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin

from pytest_twin.errors import ModelError
from pytest_twin.realization.named_model import NamedModel
from pytest_twin.realization.node import Node
from pytest_twin.realization.rigid_model import RigidModel, add_inertia, moments
from pytest_twin.realization.urdf import Robot

_KINEMATIC = frozenset({"pos", "quat", "axis", "ref"})
_KEPT_TAGS = frozenset(
    {
        *("robot", "link", "joint", "inertial", "mass", "inertia"),
        *("origin", "parent", "child", "axis", "limit", "dynamics"),
    }
)
_REQUIRED = {
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
    "limit": ("effort", "velocity"),
}


def is_described(realization: NamedModel, robot: Robot) -> bool:
    """Whether the URDF alone determines the kinematics: no fit changes a frame or an axis."""
    twin = realization.twin
    if twin is None:
        return True
    if robot.root == "world" and twin.calibration and twin.calibration.transform_world_to_base:
        return False
    return twin.fit is None or not any(
        _KINEMATIC & set(patch)
        for family in ("body", "joint")
        for patch in twin.fit.patches.get(family, {}).values()
    )


def build(realization: NamedModel, robot: Robot) -> RigidModel:
    """Build the Pinocchio model of a URDF.

    Raises:
        ModelError: Pinocchio refuses it, or a joint has more than one degree of freedom on a
            moving link (MuJoCo replaces it by several joints).
    """
    for joint in robot.joints.values():
        if joint.type == "planar" or (
            joint.type == "floating" and joint.name not in realization.joints
        ):
            raise joint.node.error(
                f"no independent reference for a {joint.type} joint here",
                expected="a joint of one degree of freedom",
            )
    text = dynamics_text(robot.node)
    try:
        model = pin.buildModelFromXML(text)
    except (ValueError, RuntimeError, IndexError) as error:
        raise ModelError(
            f"Pinocchio refuses the model: {' '.join(str(error).split())}", path=realization.path
        ) from None
    found = RigidModel(model=model, world=_world_to_base(realization))
    model.gravity.linear = found.world.rotation.T @ np.array(realization.spec.option.gravity)
    for name in realization.joints:
        found.joints[name] = model.getJointId(name)
        if model.joints[found.joints[name]].nv == 6:
            found.neutral[name] = realization.model.qpos0[realization.joint_qpos_index(name) :][
                :7
            ].copy()
    found.frames["world"] = (0, found.world.inverse())
    for link in robot.links:
        frame = model.frames[model.getFrameId(link, pin.FrameType.BODY)]
        found.frames[link] = (frame.parentJoint, frame.placement)
    _replace_changed_inertias(found, realization, robot)
    for joint_spec in realization.spec.joints:
        found.armature[joint_spec.name] = float(joint_spec.armature)
    return found


def _replace_changed_inertias(found: RigidModel, realization: NamedModel, robot: Robot) -> None:
    """Replace the inertias of links that a fit, a payload or a repair has changed."""
    for link in robot.links.values():
        body = realization.spec.body(link.name)
        if body is None or link.name == "world":
            continue
        axes = pin.Quaternion(*body.iquat).matrix()
        stated = axes @ np.diag(body.inertia) @ axes.T
        same = (
            body.mass == link.mass
            and np.array_equal(body.ipos, link.com)
            and np.allclose(stated, link.inertia, rtol=1e-9, atol=1e-15)
        )
        if same:
            continue
        joint, placement = found.frames[link.name]
        written = moments(link.mass, link.com, link.inertia, placement)
        true = moments(body.mass, np.array(body.ipos), stated, placement)
        add_inertia(found.model, joint, (-1.0, written), (1.0, true))


def _world_to_base(realization: NamedModel) -> pin.SE3:
    twin = realization.twin
    base = twin.calibration.transform_world_to_base if twin and twin.calibration else None
    if base is None:
        return pin.SE3.Identity()
    return pin.SE3(pin.Quaternion(*base.quaternion), np.array(base.position))


def dynamics_text(node: Node) -> str:
    """URDF text with kinematics and inertias only, without shapes, files and mimic elements.

    Missing values are written as 0: urdfdom, the parser of Pinocchio, ignores an inertial without
    one product of inertia, and refuses a robot with a limit without effort.
    """
    stated = {**dict.fromkeys(_REQUIRED.get(node.tag, ()), "0"), **node.attributes}
    attributes = "".join(
        # An attribute with a namespace prefix belongs to another tool.
        f" {key}={quoteattr(value)}"
        for key, value in stated.items()
        if ":" not in key
    )
    inner = "".join(dynamics_text(child) for child in node.children if child.tag in _KEPT_TAGS)
    if node.tag == "inertial":
        for tag in ("mass", "inertia"):
            if node.find(tag) is None:
                zeros = "".join(f' {key}="0"' for key in _REQUIRED[tag])
                inner += f"<{tag}{zeros}/>"
    limited = node.tag == "joint" and node.attributes.get("type") in ("revolute", "prismatic")
    if limited and node.find("limit") is None:
        inner += '<limit effort="0" velocity="0"/>'
    return f"<{node.tag}{attributes}>{inner}</{node.tag}>"
