"""Reduce the rounding error of joint axes in UsdPhysics.

The frame of a joint is a quaternion in single precision, so that an oblique axis has an error of up
to 1e-7 rad. The rotation of the frame about the axis is free. Of many such rotations, the one whose
rounded quaternion gives the smallest error of the axis is chosen.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pytest_twin.realization.urdf import Robot
from pytest_twin.realization.urdf_tree import SCALAR
from pytest_twin.realization.usd_names import display_name

Vector = NDArray[np.float64]
_CLOSE = 1e-10
"""Largest error of an axis that is not improved."""
_ROLLS = 200_000
"""Number of random roll angles, of which the one with the smallest rounding error is chosen."""
_TOKENS = {"X": 0, "Y": 1, "Z": 2}


def improve_axes(stage: Any, robot: Robot) -> None:
    """Replace the frames of joints whose axis has an error above 1e-10."""
    from pxr import Gf, UsdGeom, UsdPhysics

    cache = UsdGeom.XformCache()
    prims = {display_name(p): p for p in stage.Traverse() if p.IsA(UsdPhysics.Joint)}
    for joint in robot.joints.values():
        prim = prims.get(joint.name)
        if prim is None or joint.type not in SCALAR:
            continue
        typed = getattr(UsdPhysics, str(prim.GetTypeName()).removeprefix("Physics"))(prim)
        token = np.eye(3)[_TOKENS[str(typed.GetAxisAttr().Get())]]
        held = _rotation(typed.GetLocalRot1Attr().Get()).apply(token)
        if np.abs(held - joint.axis).max() <= _CLOSE:
            continue
        frame = single_precision_frame(token, joint.axis)
        sides = [_world(cache, stage, r) for r in (typed.GetBody0Rel(), typed.GetBody1Rel())]
        first = sides[0].inv() * sides[1] * Rotation.from_quat(frame)
        for attribute, (x, y, z, w) in (
            (typed.GetLocalRot0Attr(), first.as_quat()),
            (typed.GetLocalRot1Attr(), frame),
        ):
            attribute.Set(Gf.Quatf(float(w), float(x), float(y), float(z)))


def single_precision_frame(token: Vector, axis: Vector) -> Vector:
    """(4,) quaternion x y z w in single precision that rotates ``token`` (3,) to ``axis`` (3,)."""
    turn = Rotation.align_vectors(axis[None], token[None])[0]
    # All frames with that axis: the rotation, after a roll by twice an angle.
    straight = turn.as_quat()
    across = (turn * Rotation.from_quat([*token, 0.0])).as_quat(canonical=False)
    angles = np.random.default_rng(7).uniform(0.0, np.pi, (_ROLLS, 1))
    rounded = (np.cos(angles) * straight + np.sin(angles) * across).astype(np.float32)
    frames = rounded.astype(np.float64)
    vector, scalar = frames[:, :3], frames[:, 3:]
    # q token q*, without normalization: the length is 1 up to 1e-7.
    turned = (
        2.0 * (vector @ token)[:, None] * vector
        + (scalar**2 - (vector**2).sum(axis=1, keepdims=True)) * token
        + 2.0 * scalar * np.cross(vector, token)
    )
    apart = np.linalg.norm(np.cross(turned, axis), axis=1)
    best: Vector = frames[int(np.argmin(apart))]
    return best


def _rotation(quaternion: Any) -> Rotation:
    return Rotation.from_quat([*quaternion.GetImaginary(), quaternion.GetReal()])


def _world(cache: Any, stage: Any, relation: Any) -> Rotation:
    targets = relation.GetTargets()
    if not targets:
        return Rotation.identity()
    matrix = cache.GetLocalToWorldTransform(stage.GetPrimAtPath(targets[0]))
    return Rotation.from_matrix(np.array(matrix, dtype=np.float64)[:3, :3].T)
