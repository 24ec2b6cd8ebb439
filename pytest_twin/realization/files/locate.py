"""Find the root folder and the ROS packages of a model."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pytest_twin.errors import PathError
from pytest_twin.formats import xml
from pytest_twin.formats.declared_inputs import declared_inputs
from pytest_twin.formats.paths import Roots
from pytest_twin.realization import mjcf
from pytest_twin.realization.files.packages import BY_NAME_ABOVE, Packages
from pytest_twin.realization.files.root import Folder, ModelRoot, choose, inside
from pytest_twin.realization.files.surroundings import folders_above
from pytest_twin.realization.files.urdf import MujocoFolders, UrdfFiles
from pytest_twin.twin import Twin


@dataclass(frozen=True, slots=True)
class ModelFolders:
    """Folders that may contain the files of a model.

    Attributes:
        roots: all folders that referenced files may be in.
        packages: resolves ``package://`` references.
        root: the chosen root folder; None where a twin declares the roots.
    """

    roots: Roots
    packages: Packages
    root: ModelRoot | None = None

    def words(self) -> tuple[str, ...]:
        """Describe the chosen folders, one line each; empty for the model's own folder only."""
        lines = []
        if self.root is not None and self.root.folder != self.roots.base:
            lines.append(f"root of the model: {self.root.folder} ({self.root.why})")
        for name, package in sorted(self.packages.found.items()):
            lines.append(f"package '{name}': {package.folder} (found by {package.by})")
        for beginning, name in sorted(self.packages.renamed.items()):
            lines.append(f"{beginning} is taken for package '{name}'")
        return tuple(lines)

    def to_json(self) -> dict[str, Any]:
        """Return the chosen folders as JSON-able values."""
        root = self.root
        return {
            "root": None if root is None else {"folder": str(root.folder), "why": root.why},
            "packages": {
                name: {"folder": str(package.folder), "found_by": package.by}
                for name, package in sorted(self.packages.found.items())
            },
        }


def locate(
    path: Path,
    *,
    twin: Twin | None = None,
    roots: Roots | None = None,
) -> ModelFolders:
    """Find the root folder and the packages of a model; only its XML files are read.

    Args:
        path: the model's file, in a folder without symbolic links.
        twin: the twin; its roots are used, and none is chosen.
        roots: roots that are used instead of a chosen one.

    Raises:
        FormatError: the file is not well-formed XML.
        LimitError: the file is larger than a limit.
    """
    search = declared_inputs()
    declared = {} if twin is None else twin.roots
    if twin is not None and roots is None:
        roots = twin.path_roots
    if roots is not None:
        above = [folder for folder in path.parents if roots.contains(folder)]
        others = [folder for folder in roots.folders if folder not in above]
        return ModelFolders(roots, Packages(above, others, search.packages, declared))
    surroundings = folders_above(path)
    allowed = [folder.path for folder in inside(surroundings)]
    packages = Packages(allowed, search.roots, search.packages)
    root = _choose(path, surroundings, packages, search.roots)
    beside = [
        package.folder
        for package in packages.found.values()
        if not package.folder.is_relative_to(root.folder)
    ]
    extra = (root.folder, *beside)
    return ModelFolders(Roots(path.parent, tuple(dict.fromkeys(extra))), packages, root)


def _choose(
    path: Path,
    surroundings: Sequence[Folder],
    packages: Packages,
    others: Sequence[Path],
) -> ModelRoot:
    outermost = inside(surroundings)[-1].path
    element = xml.parse(path)
    named: set[Path] = set()
    if element.tag == "robot":
        files = UrdfFiles(Roots(path.parent), packages, MujocoFolders.of(element))
        for node in element.iter("mesh", "texture"):
            reference = node.get("filename") or ""
            # An invalid reference is reported when the file is read.
            with suppress(PathError, OSError, ValueError):
                named.add(files.path_of(reference, path))
    elif element.tag == "mujoco":
        named = mjcf.named_files(path, Roots(outermost))
    found = packages.found.values()
    by_name = {package.folder for package in found if package.by == BY_NAME_ABOVE}
    elsewhere = [package.folder for package in found if not path.is_relative_to(package.folder)]
    there = [Path(os.path.normpath(file)) for file in named if _exists(file)]
    own = [
        file
        for file in there
        if not any(file.is_relative_to(folder) for folder in (*elsewhere, *others))
    ]
    return choose(surroundings, own, by_name)


def _exists(path: Path) -> bool:
    try:
        return os.path.lexists(path)
    except (OSError, ValueError):
        return False
