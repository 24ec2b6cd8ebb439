"""Transformations of a robot as a tree of rigid bodies: mirrored, or with another root.

This module reads no files.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from lxml import etree
from numpy.typing import NDArray

from pytest_twin.formats.xml import digits
from pytest_twin.metrics.pose import inverse, rigid, rotation_of
from pytest_twin.realization.tree import RigidTree, TreeBody, TreeJoint

Vector = NDArray[np.float64]

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
"""(4, 4) reflection at the plane of x and z."""


GROUND = "the world"
"""Name for MuJoCo's body ``world``, which may become the child of another body."""


def tree_of(model: Any) -> RigidTree:
    """Build the tree of a compiled MuJoCo model, with the world as its root.

    Several joints of one body are connected by bodies without mass. Ball and free joints stay at
    their initial pose. The value of a joint is relative to its reference (``qpos0``).
    """
    import mujoco

    bodies = [TreeBody(GROUND, None, np.eye(4), None, 0.0, np.zeros(3), np.zeros((3, 3)))]
    names = [GROUND, *(_name(model, i) for i in range(1, model.nbody))]
    for i in range(1, model.nbody):
        parent = names[int(model.body_parentid[i])]
        placement = _pose(model.body_pos[i], model.body_quat[i])
        start, count = int(model.body_jntadr[i]), int(model.body_jntnum[i])
        scalar = [
            j
            for j in range(start, start + count)
            if int(model.jnt_type[j])
            in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
        ]
        for j in scalar[:-1]:
            between = f"{names[i]}/{j - start}"
            bodies.append(
                TreeBody(
                    between, parent, placement, _joint(model, j), 0.0, np.zeros(3), np.zeros((3, 3))
                )
            )
            parent, placement = between, np.eye(4)
        axes = _pose(np.zeros(3), model.body_iquat[i])[:3, :3]
        bodies.append(
            TreeBody(
                names[i],
                parent,
                placement,
                _joint(model, scalar[-1]) if scalar else None,
                float(model.body_mass[i]),
                np.array(model.body_ipos[i]),
                axes @ np.diag(model.body_inertia[i]) @ axes.T,
            )
        )
    return RigidTree(bodies)


def mirror(tree: RigidTree) -> RigidTree:
    """The mirrored tree.

    The axis of a hinge is a pseudovector, so that its sign changes; that of a slide is a vector.
    """
    flip = MIRROR[:3, :3]
    found = []
    for body in tree.bodies.values():
        joint = body.joint
        if joint is not None:
            axis = flip @ joint.axis
            joint = replace(
                joint,
                axis=axis if joint.kind == "slide" else -axis,
                anchor=MIRROR @ joint.anchor @ MIRROR,
            )
        found.append(
            replace(
                body,
                placement=MIRROR @ body.placement @ MIRROR,
                joint=joint,
                com=flip @ body.com,
                inertia=flip @ body.inertia @ flip,
            )
        )
    return RigidTree(found)


def reroot(tree: RigidTree, root: str) -> RigidTree:
    """The same robot with another root; the joints between the two roots are reversed.

    ``T = X A m(q) inv(A)`` from parent to child becomes ``inv(X) (X A) m(-q) inv(X A)``.
    """
    found: list[TreeBody] = []
    turned: set[str] = set()
    body = tree.bodies[root]
    placement, joint = np.eye(4), None
    parent: str | None = None
    while True:
        found.append(replace(body, parent=parent, placement=placement, joint=joint))
        turned.add(body.name)
        if body.parent is None:
            break
        placement = inverse(body.placement)
        joint = None
        if body.joint is not None:
            joint = TreeJoint(
                body.joint.name,
                body.joint.kind,
                -body.joint.axis,
                body.placement @ body.joint.anchor,
            )
        parent, body = body.name, tree.bodies[body.parent]
    found += [other for other in tree.bodies.values() if other.name not in turned]
    return RigidTree(found)


def leaves(tree: RigidTree) -> list[str]:
    """Names of the bodies without children."""
    parents = {body.parent for body in tree.bodies.values()}
    return [name for name in tree.bodies if name not in parents]


def urdf_text(tree: RigidTree, name: str = "robot") -> str:
    """URDF of the tree with full precision; a link is added for each joint frame."""
    root = etree.Element("robot", name=name)
    for body in tree.bodies.values():
        link = etree.SubElement(root, "link", name=body.name)
        if body.mass > 0 or np.any(body.inertia):
            inertial = etree.SubElement(link, "inertial")
            etree.SubElement(inertial, "origin", xyz=digits(body.com), rpy="0 0 0")
            etree.SubElement(inertial, "mass", value=repr(body.mass))
            i = body.inertia
            made = etree.SubElement(inertial, "inertia")
            for key, value in zip(
                ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"),
                (i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]),
                strict=True,
            ):
                made.set(key, repr(float(value)))
        if body.parent is None:
            continue
        if body.joint is None:
            _add_joint(root, f"{body.name}/held", "fixed", body.parent, body.name, body.placement)
            continue
        between = f"{body.name}/at {body.joint.name}"
        etree.SubElement(root, "link", name=between)
        start = body.placement @ body.joint.anchor
        kind = "prismatic" if body.joint.kind == "slide" else "continuous"
        made = _add_joint(root, body.joint.name, kind, body.parent, between, start)
        etree.SubElement(made, "axis", xyz=digits(body.joint.axis))
        if kind == "prismatic":
            etree.SubElement(made, "limit", lower="-1e9", upper="1e9", effort="0", velocity="0")
        back = inverse(body.joint.anchor)
        _add_joint(root, f"{body.name}/held", "fixed", between, body.name, back)
    return str(etree.tostring(root, encoding="unicode"))


def _add_joint(root: Any, name: str, kind: str, parent: str, child: str, pose: Vector) -> Any:
    made = etree.SubElement(root, "joint", name=name, type=kind)
    origin = digits(pose[:3, 3])
    etree.SubElement(made, "origin", xyz=origin, rpy=digits(_rpy(pose[:3, :3])))
    etree.SubElement(made, "parent", link=parent)
    etree.SubElement(made, "child", link=child)
    return made


def _rpy(rotation: Vector) -> tuple[float, float, float]:
    """Roll, pitch, yaw about fixed axes, rad; in the singularity, yaw is 0."""
    r = rotation
    flat = math.hypot(r[0, 0], r[1, 0])
    pitch = math.atan2(-r[2, 0], flat)
    if flat < 1e-9:
        return math.atan2(-r[1, 2], r[1, 1]), pitch, 0.0
    return math.atan2(r[2, 1], r[2, 2]), pitch, math.atan2(r[1, 0], r[0, 0])


def joint_names(model: Any) -> list[str]:
    """Names of all joints of a MuJoCo model; one without a name is ``joint#`` and its index."""
    return [model.joint(i).name or f"joint#{i}" for i in range(model.njnt)]


def _joint(model: Any, index: int) -> TreeJoint:
    import mujoco

    slide = int(model.jnt_type[index]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
    anchor = np.eye(4)
    anchor[:3, 3] = model.jnt_pos[index]
    return TreeJoint(
        joint_names(model)[index],
        "slide" if slide else "hinge",
        np.array(model.jnt_axis[index]),
        anchor,
    )


def _name(model: Any, index: int) -> str:
    return model.body(index).name or f"body#{index}"


def _pose(position: Vector, quaternion: Vector) -> Vector:
    return rigid(rotation_of(quaternion), position)
