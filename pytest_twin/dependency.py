"""Parts, what a golden rests on, and what a change of them makes stale. No simulator, no files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any


def canonical(content: object) -> bytes:
    """One byte string per meaning: sorted keys, no spaces, floats to 12 significant digits.

    Raises:
        ValueError: ``content`` holds a number that is not finite.
    """
    return json.dumps(
        _rounded(content), sort_keys=True, separators=(",", ":"), allow_nan=False
    ).encode()


def _rounded(content: object) -> object:
    if isinstance(content, float):
        # 12 digits: reformatted or re-derived numbers agree, and no check feels the rest.
        return float(f"{content:.12g}") + 0.0
    if isinstance(content, Mapping):
        return {str(key): _rounded(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_rounded(value) for value in content]
    return content


@dataclass(frozen=True, slots=True)
class Part:
    """One thing that checks can feel.

    Attributes:
        id: ``layer:name``, such as ``inertia:forearm`` or ``simulator:mujoco``; parts of a
            realization carry its name in front, ``mujoco/inertia:forearm``.
        content: what the part consists of, JSON-able; long arrays as their digest.
    """

    id: str
    content: Mapping[str, Any]

    @property
    def digest(self) -> str:
        """SHA-256 of the canonical content, hex."""
        return hashlib.sha256(canonical(self.content)).hexdigest()


@dataclass(frozen=True, slots=True)
class Structure:
    """How a realization hangs together: enough to say which parts a check can feel.

    All names are the realization's own; ``world`` is the root body and has no parent.

    Attributes:
        realization: the name in front of the part ids.
        body_parent: body -> parent body.
        joint_body: joint -> body that it moves.
        joint_range: joint -> (lower, upper) in rad or m, or None where unlimited.
        joint_type: joint -> ``hinge``, ``slide``, ``ball`` or ``free``.
        frame_body: named frame (site or body) -> body.
        actuator_joints: actuator -> joints that it drives (through tendons too).
        collision_bodies: bodies with a geom that can collide.
        couplings: groups of bodies or joints tied by an equality, a tendon or a plugin, each a
            part id and the bodies that it touches.
        part_ids: every part of the realization.
    """

    realization: str
    body_parent: Mapping[str, str]
    joint_body: Mapping[str, str]
    joint_range: Mapping[str, tuple[float, float] | None]
    joint_type: Mapping[str, str]
    frame_body: Mapping[str, str]
    actuator_joints: Mapping[str, tuple[str, ...]]
    collision_bodies: frozenset[str]
    couplings: Mapping[str, tuple[str, ...]]
    part_ids: frozenset[str] = field(repr=False)
