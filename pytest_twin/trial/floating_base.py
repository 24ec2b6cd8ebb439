"""Recordings of joints for a robot whose base floats: nothing states where the base is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pytest_twin.dependency import Structure
from pytest_twin.errors import RecordingError
from pytest_twin.words import list_names


def check_floating_base(
    structure: Structure, recorded: Sequence[str], path: Path, *, has_pose: bool = False
) -> list[str]:
    """Check that nothing that carries the recorded joints moves freely.

    Args:
        recorded: recorded joints, with the model's names.
        path: path of the recording, for errors.
        has_pose: whether the pose of a base with a free joint was recorded and is used.

    Returns:
        A note on joints that could be recorded, are not, and move freely.

    Raises:
        RecordingError: a free or ball joint carries a recorded joint.
    """
    loose = structure.loose - set(recorded)
    by_body: dict[str, list[str]] = {}
    for joint in structure.joint_body if loose else ():
        if joint in loose:
            by_body.setdefault(structure.joint_body[joint], []).append(joint)
    carrying: dict[str, None] = {}
    for joint in recorded if loose else ():
        body = structure.joint_body.get(joint)
        while body is not None:
            for carrier in by_body.get(body, ()):
                kind = structure.joint_type[carrier]
                if has_pose and kind == "free":
                    continue
                if kind in ("free", "ball") and not _is_held(structure, body):
                    raise _floats(kind, joint, path)
                carrying[carrier] = None
            body = structure.body_parent.get(body)
    free = [joint for joint in carrying if structure.joint_type[joint] in ("hinge", "slide")]
    if not free:
        return []
    return [
        f"not recorded, and nothing in the model holds them: {list_names(free)}; they carry "
        "recorded joints, start at the model's reference and move freely"
    ]


def is_floating(structure: Structure, recorded: Sequence[str]) -> bool:
    """Whether a free joint carries one of the recorded joints."""
    free = {structure.joint_body[j] for j, kind in structure.joint_type.items() if kind == "free"}
    for joint in recorded:
        body = structure.joint_body.get(joint)
        while body is not None:
            if body in free and not _is_held(structure, body):
                return True
            body = structure.body_parent.get(body)
    return False


def _is_held(structure: Structure, body: str) -> bool:
    """Whether an equality, such as a weld, connects the body's tree with something else."""
    tree = structure.body_tree.get(body)
    connected = (
        {structure.body_tree.get(end) for end in structure.couplings[part]}
        for part in structure.equalities
    )
    return any(tree in trees and len(trees) > 1 for trees in connected)


def _floats(kind: str, joint: str, path: Path) -> RecordingError:
    return RecordingError(
        f"the model's base floats (a {kind} joint carries joint {joint!r}), and the recording does "
        "not say where it is",
        path=path,
        value="joint states alone",
        expected="a robot that a rig held: --base fixed, or 'base: fixed' in twin.yaml; or its "
        "pose: --topics base=TOPIC, or columns base.x y z qw qx qy qz of a CSV file",
    )
