"""Recordings of joints for a robot whose base floats: nothing states where the base is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pytest_twin.dependency import Structure
from pytest_twin.errors import RecordingError
from pytest_twin.words import list_names


def check_floating_base(structure: Structure, recorded: Sequence[str], path: Path) -> list[str]:
    """Check that nothing that carries the recorded joints moves freely.

    Args:
        structure: structure of the model.
        recorded: recorded joints, with the model's names.
        path: path of the recording, for errors.

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
        expected="a robot that a rig held: --base fixed, or 'base: fixed' in twin.yaml",
    )
