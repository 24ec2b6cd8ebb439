"""Properties of the same robot after export and import, mirroring, or a change of its root link."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from pytest_twin.formats.temporary import temporary_folder
from pytest_twin.metrics.pose import inverse, orientation_error, position_error
from pytest_twin.properties import trees
from pytest_twin.properties.agreement import Q, matrix_of
from pytest_twin.properties.asset import Asset
from pytest_twin.properties.form import Form, mujoco_form, pinocchio_form
from pytest_twin.properties.violation import Broken

Vector = NDArray[np.float64]
_TINY_INERTIA = 1e-10
"""Absolute tolerance of a mass matrix, kg, kg*m or kg*m^2, for parts that are zero."""


@dataclass(frozen=True, slots=True)
class _Imported:
    """A transformed robot, imported again.

    Attributes:
        floating: its Pinocchio model with a floating base.
    """

    forms: tuple[Form, ...]
    floating: Any


_made: WeakKeyDictionary[Form, dict[str, _Imported]] = WeakKeyDictionary()


def written_and_read(asset: Asset, q: Q) -> Iterator[Broken]:
    """The robot is the same after it is written as URDF and imported again."""
    for form in asset.simulated:
        imported = _import(form, "as it is", lambda tree: tree)
        yield from _compare(asset, form, imported, q, np.eye(4), "written as URDF and read")


def mirrored(asset: Asset, q: Q) -> Iterator[Broken]:
    """The mirrored robot has mirrored poses and the same mass matrix at the same joint values."""
    for form in asset.simulated:
        imported = _import(form, "mirrored", trees.mirror)
        yield from _compare(asset, form, imported, q, trees.MIRROR, "mirrored")


def rerooted(asset: Asset, q: Q) -> Iterator[Broken]:
    """With its last link as the root, the relative poses of all links are the same.

    With a floating base, the joint inertia M_jj - M_jb inv(M_bb) M_bj does not depend on the choice
    of the base link.
    """
    for form in asset.simulated:
        last = trees.leaves(trees.tree_of(form.model))[-1]
        plain = _import(form, "as it is", lambda tree: tree)
        turned = _import(form, "rerooted", lambda tree, last=last: trees.reroot(tree, last))
        poses = form.dynamics.poses(q)
        base = inverse(poses[last])
        own = _from_reference(form, q)
        for other in turned.forms:
            theirs = other.dynamics.poses(own)
            for frame in (frame for frame in poses if frame in theirs):
                yield from _compare_poses(
                    asset,
                    form,
                    frame,
                    base @ poses[frame],
                    theirs[frame],
                    f"with root '{last}'",
                    other.name,
                )
        joints = form.dynamics.joints
        one, two = (_floating_base_inertia(i.floating, own, joints) for i in (plain, turned))
        how = f"with a floating base and root '{last}'"
        yield from _compare_inertias(asset, joints, matrix_of(form, q), one - two, how, form.name)


def _import(form: Form, key: str, change: Any) -> _Imported:
    import pinocchio as pin

    known = _made.setdefault(form, {})
    if key not in known:
        text = trees.urdf_text(change(trees.tree_of(form.model)))
        with temporary_folder() as folder:
            path = folder / "robot.urdf"
            path.write_text(text, encoding="utf-8")
            forms = (mujoco_form(path), pinocchio_form(path))
        floating = pin.buildModelFromXML(text, pin.JointModelFreeFlyer())
        known[key] = _Imported(forms, floating)
    return known[key]


def _from_reference(form: Form, q: Q) -> dict[str, float]:
    """Joint values relative to the model's reference, as in its tree."""
    model = form.model
    found = {}
    for joint in form.dynamics.joints:
        joint_id = trees.joint_names(model).index(joint)
        start = float(model.qpos0[model.jnt_qposadr[joint_id]])
        found[joint] = q.get(joint, start) - start
    return found


def _compare(
    asset: Asset, form: Form, imported: _Imported, q: Q, mirror: Vector, how: str
) -> Iterator[Broken]:
    own, poses = _from_reference(form, q), form.dynamics.poses(q)
    joints = form.dynamics.joints
    matrix = matrix_of(form, q)
    for other in imported.forms:
        theirs = other.dynamics.poses(own)
        for frame in (frame for frame in poses if frame in theirs):
            expected = mirror @ poses[frame] @ mirror
            yield from _compare_poses(asset, form, frame, expected, theirs[frame], how, other.name)
        off = matrix_of(other, own, joints) - matrix
        forms = f"{form.name}, imported again by {other.name}"
        yield from _compare_inertias(asset, joints, matrix, off, how, forms)


def _compare_inertias(
    asset: Asset, joints: Sequence[str], matrix: Vector, off: Vector, how: str, forms: str
) -> Iterator[Broken]:
    """Compare errors ``off`` of the joint inertias (n, n) with the tolerance of ``matrix``."""
    held = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    bounds = asset.tolerances.mass_matrix * np.outer(held, held) + _TINY_INERTIA
    apart = np.abs(off)
    if joints and not np.all(apart <= bounds):
        i, k = np.unravel_index(int(np.argmax(apart / bounds)), apart.shape)
        yield Broken(
            f"joint '{joints[int(i)]}'",
            f"{how}, has another inertia, off",
            float(apart[i, k]),
            float(bounds[i, k]),
            "kg*m^2, kg*m or kg",
            forms,
        )


def _compare_poses(
    asset: Asset, form: Form, frame: str, one: Vector, two: Vector, how: str, by: str
) -> Iterator[Broken]:
    forms = f"{form.name}, imported again by {by}"
    apart = position_error(two[:3, 3], one[:3, 3])
    if not apart <= asset.tolerances.position:
        words = f"{how}, has another position"
        yield Broken(f"frame '{frame}'", words, apart, asset.tolerances.position, "m", forms)
    turned = orientation_error(two[:3, :3], one[:3, :3])
    if not turned <= asset.tolerances.orientation:
        words = f"{how}, has another orientation"
        yield Broken(f"frame '{frame}'", words, turned, asset.tolerances.orientation, "rad", forms)


def _floating_base_inertia(model: Any, q: Q, joints: tuple[str, ...]) -> Vector:
    """(n, n) joint inertia with a floating base, in the order of ``joints``."""
    import pinocchio as pin

    full = pin.neutral(model)
    columns = []
    for name in joints:
        joint = model.joints[model.getJointId(name)]
        value = q.get(name, 0.0)
        wide = joint.nq == 2
        full[joint.idx_q : joint.idx_q + joint.nq] = (
            [np.cos(value), np.sin(value)] if wide else [value]
        )
        columns.append(joint.idx_v)
    matrix = np.array(pin.crba(model, model.createData(), full))
    matrix = np.triu(matrix) + np.triu(matrix, 1).T
    coupled = matrix[:6, columns]
    inner = matrix[np.ix_(columns, columns)]
    return np.asarray(inner - coupled.T @ np.linalg.solve(matrix[:6, :6], coupled))
