"""Hold the floating base of a robot, as a rig does."""

from __future__ import annotations

import mujoco
import numpy as np

from pytest_twin.realization import patch

_LOOSE = (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)


def fix_base(spec: mujoco.MjSpec) -> list[str]:
    """Remove the joints of floating bases, which stay at the pose that the model gives them.

    A base has a free or ball joint, its parent is fixed to the world, and it carries other joints.
    A free body without joints is an object and stays free. Keyframes lose the
    coordinates of the base.

    Args:
        spec: the spec, which is changed.

    Returns:
        One note for each base.

    Raises:
        ValueError: the spec cannot be compiled.
    """
    bases = _floating_bases(spec)
    if not bases:
        return []
    whole = spec.compile()
    joints = [joint.id for base in bases for joint in base.joints]
    notes = []
    for base in bases:
        position = " ".join(f"{x:.4g}" for x in whole.body_pos[base.id])
        name = f"body {base.name!r}" if base.name else "an unnamed body"
        notes.append(f"base: fixed: {name} is held at {position} m")
        for joint in list(base.joints):
            spec.delete(joint)
    _shorten_keyframes(spec, whole, joints)
    return notes


def _shorten_keyframes(spec: mujoco.MjSpec, whole: mujoco.MjModel, joints: list[int]) -> None:
    """Remove the coordinates of deleted joints from keyframes; MuJoCo 4 does it on deletion."""
    for name, first, size in (
        ("qpos", whole.jnt_qposadr, whole.nq),
        ("qvel", whole.jnt_dofadr, whole.nv),
    ):
        ends = np.append(first[1:], size)
        dropped = [np.arange(first[joint], ends[joint]) for joint in joints]
        for key in spec.keys:
            values = np.array(getattr(key, name))
            if values.size == size:
                setattr(key, name, np.delete(values, np.concatenate(dropped)))


def _floating_bases(spec: mujoco.MjSpec) -> list[mujoco.MjsBody]:
    floating_bodies = []
    waiting = list(spec.worldbody.bodies)
    while waiting:
        body = waiting.pop()
        if not body.joints:
            waiting.extend(body.bodies)
        elif any(joint.type in _LOOSE for joint in body.joints) and patch.carries_joints(body):
            floating_bodies.append(body)
    return floating_bodies
