"""Folders that the user declares on the command line: ``--root`` and ``--package``.

They hold for everything that the command reads, in its child processes too: models with their
meshes, recordings, images, records.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class DeclaredFolders:
    """Folders from which files may be read, in addition to those of a model or a twin.

    Attributes:
        roots: absolute paths of folders, and of files that were named themselves.
        packages: ROS package -> its folder.
    """

    roots: tuple[Path, ...] = ()
    packages: Mapping[str, Path] = field(default_factory=dict)

    @staticmethod
    def of(content: Mapping[str, Any]) -> DeclaredFolders:
        """Build the object from what :meth:`to_json` returned."""
        return DeclaredFolders(
            tuple(map(Path, content["roots"])),
            {name: Path(folder) for name, folder in content["packages"].items()},
        )

    def to_json(self) -> dict[str, Any]:
        """JSON-able values, for a child process."""
        return {
            "roots": [str(root) for root in self.roots],
            "packages": {name: str(folder) for name, folder in self.packages.items()},
        }


_declared = DeclaredFolders()


def declared_folders() -> DeclaredFolders:
    """Folders that the command in progress declares."""
    return _declared


@contextmanager
def declaring(folders: DeclaredFolders) -> Iterator[None]:
    """Declare folders for this process while the context is open."""
    global _declared
    before, _declared = _declared, folders
    try:
        yield
    finally:
        _declared = before
