"""Inputs that the command line declares: ``--root``, ``--package``, an expanded xacro file.

They hold for everything that the command reads, in its child processes too: models with their
meshes, recordings, images, records.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.formats.expansions import Expansion


@dataclass(frozen=True, slots=True)
class DeclaredInputs:
    """Folders and files that a command may read, in addition to those of a model or a twin.

    Attributes:
        roots: absolute paths of folders, and of files that were named themselves.
        packages: ROS package -> its folder.
        expansion: the xacro file that the command expanded; None without one.
    """

    roots: tuple[Path, ...] = ()
    packages: Mapping[str, Path] = field(default_factory=dict)
    expansion: Expansion | None = None

    @staticmethod
    def of(content: Mapping[str, Any]) -> DeclaredInputs:
        """Build the object from what :meth:`to_json` returned."""
        expansion = content["expansion"]
        return DeclaredInputs(
            tuple(map(Path, content["roots"])),
            {name: Path(folder) for name, folder in content["packages"].items()},
            None if expansion is None else Expansion.of(expansion),
        )

    def to_json(self) -> dict[str, Any]:
        """JSON-able values, for a child process."""
        return {
            "roots": [str(root) for root in self.roots],
            "packages": {name: str(folder) for name, folder in self.packages.items()},
            "expansion": None if self.expansion is None else self.expansion.to_json(),
        }


_declared = DeclaredInputs()


def declared_inputs() -> DeclaredInputs:
    """Inputs that the command in progress declares."""
    return _declared


def expansion_of(path: Path) -> Expansion | None:
    """The expansion of a file; None for every file that was not expanded."""
    expansion = _declared.expansion
    return expansion if expansion is not None and expansion.source == path else None


@contextmanager
def declaring(inputs: DeclaredInputs) -> Iterator[None]:
    """Declare inputs for this process while the context is open."""
    global _declared
    before, _declared = _declared, inputs
    try:
        yield
    finally:
        _declared = before
