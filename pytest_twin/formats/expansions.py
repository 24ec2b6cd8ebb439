"""Xacro files that a command expanded: whoever parses one reads the URDF that came out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SUFFIX = ".xacro"
EXPANDED = ".expanded.urdf"
"""End of the name of the file in which a command keeps what a xacro file expanded to."""


@dataclass(frozen=True, slots=True)
class Expansion:
    """A xacro file and the URDF that came out of it.

    Attributes:
        urdf: file with the text of the URDF; its relative paths start at the folder of ``source``.
        read: the xacro file and everything that it includes or loads.
        arguments: name -> value, as given to xacro.
        packages: folders of the packages that it names.
    """

    source: Path
    urdf: Path
    read: tuple[Path, ...]
    arguments: Mapping[str, str]
    packages: tuple[Path, ...] = ()

    @staticmethod
    def of(content: Mapping[str, Any]) -> Expansion:
        """Build the object from what :meth:`to_json` returned."""
        return Expansion(
            Path(content["source"]),
            Path(content["urdf"]),
            tuple(map(Path, content["read"])),
            dict(content["arguments"]),
            tuple(map(Path, content["packages"])),
        )

    def to_json(self) -> dict[str, Any]:
        """JSON-able values, for a child process."""
        return {
            "source": str(self.source),
            "urdf": str(self.urdf),
            "read": [str(file) for file in self.read],
            "arguments": dict(self.arguments),
            "packages": [str(folder) for folder in self.packages],
        }


def model_stem(path: Path) -> str:
    """Name of a model without its suffixes: ``arm`` of ``arm.urdf.xacro``."""
    return Path(path.name.removesuffix(SUFFIX)).stem if path.suffix == SUFFIX else path.stem
