"""Recordings of a new twin: their paths in goldens, and the tolerance of the task."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.errors import SpecError
from pytest_twin.units import parse_quantity

ROOT = "recordings"
"""Name under ``roots:`` of the folder of recordings outside the twin."""

_UNIT_OF = {"rad": "angle_max", "m": "position_max"}


@dataclass(frozen=True, slots=True)
class TaskTolerance:
    """Largest allowed difference between predicted and recorded joint positions.

    Attributes:
        general: ``angle_max`` for hinges, ``position_max`` for slides -> quantity as written.
        joints: joint -> the same for this joint.
    """

    general: Mapping[str, str] = field(default_factory=dict)
    joints: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON-able values."""
        return {
            "general": dict(self.general),
            "joints": {joint: dict(own) for joint, own in self.joints.items()},
        }


def parse_tolerance(text: str) -> TaskTolerance:
    """Parse a tolerance such as ``5mrad``, ``5mrad,0.2mm`` or ``5mrad,wrist=2mrad``.

    Raises:
        SpecError: not a quantity in rad or m, not positive, or two for the same joints.
    """
    general: dict[str, str] = {}
    joints: dict[str, dict[str, str]] = {}
    for item in text.split(","):
        joint, given, written = item.rpartition("=")
        quantity = parse_quantity(written.strip(), tuple(_UNIT_OF))
        if not quantity.value > 0.0:
            raise SpecError("not a tolerance", value=item, expected="more than zero")
        name = _UNIT_OF[quantity.unit]
        own = joints.setdefault(joint.strip(), {}) if given else general
        if own and (given or name in own):
            raise SpecError(
                "two tolerances for the same joints",
                value=text,
                expected="one of each unit for all joints and one for each named joint, such as "
                "5mrad,0.2mm,wrist=2mrad",
            )
        own[name] = written.strip()
    return TaskTolerance(general, joints)


def place_recordings(recordings: Sequence[Path], folder: Path) -> tuple[list[str], Path | None]:
    """Reference of each recording in a golden, and the common folder of those outside the twin.

    Recordings are not copied. A recording inside the twin's folder is referred to relative to it,
    any other relative to the common folder.

    Raises:
        SpecError: a recording does not exist or is given twice, or there is no common folder.
    """
    resolved = [path.resolve() for path in recordings]
    for given, path in zip(recordings, resolved, strict=True):
        if not path.exists():
            raise SpecError("no such recording", path=given, expected="a file or folder")
        if resolved.count(path) > 1:
            raise SpecError("given twice", path=given, expected="each recording once")
    outside = [path for path in resolved if not path.is_relative_to(folder)]
    root: Path | None = None
    if outside:
        root = Path(os.path.commonpath([path.parent for path in outside]))
        if root == Path(root.anchor):
            raise SpecError(
                "the recordings have no folder in common",
                path=outside[0],
                value=", ".join(str(path) for path in outside[1:]),
                expected="recordings below one folder, or inside the twin's",
            )
    base = {path: folder if path.is_relative_to(folder) else root for path in resolved}
    return [path.relative_to(base[path] or folder).as_posix() for path in resolved], root
