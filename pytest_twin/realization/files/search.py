"""Folders from the options ``--root`` and ``--package``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypedDict


class SearchFoldersJson(TypedDict):
    """JSON-able form of :class:`SearchFolders`, for a child process."""

    roots: list[str]
    packages: dict[str, str]


@dataclass(frozen=True, slots=True)
class SearchFolders:
    """Folders that the user allows for the files of a model.

    Attributes:
        roots: folders that may contain referenced files, in addition to the model's own root.
        packages: ROS package -> its folder.
    """

    roots: tuple[Path, ...] = ()
    packages: Mapping[str, Path] = field(default_factory=dict)

    @staticmethod
    def of(roots: Sequence[str] = (), packages: Mapping[str, str] | None = None) -> SearchFolders:
        """Build the object from JSON-able values."""
        return SearchFolders(
            tuple(Path(root) for root in roots),
            {name: Path(folder) for name, folder in (packages or {}).items()},
        )

    def to_json(self) -> SearchFoldersJson:
        """Return JSON-able values, from which :meth:`of` builds the object."""
        return {
            "roots": [str(root) for root in self.roots],
            "packages": {name: str(folder) for name, folder in self.packages.items()},
        }
