"""Find the folder of a ROS package."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

from pytest_twin.errors import TwinError
from pytest_twin.formats import xml

_MAX_ENTRIES = 2000
"""Largest number of entries of a folder that are searched; ROS workspaces have hundreds."""

BY_OPTION = "--package"
BY_TWIN = "roots: in twin.yaml"
BY_NAME_ABOVE = "the name of a folder above the file"
BY_NAME_BESIDE = "the name of a folder beside one above the file"
BY_MANIFEST = "the name in package.xml"
BY_FILE = "a folder above the file that holds what is named"
BY_ROOT = "the name of a declared root, or of a folder in it"
BY_AMENT = "AMENT_PREFIX_PATH"
BY_ROS = "ROS_PACKAGE_PATH"


@dataclass(frozen=True, slots=True)
class FoundPackage:
    """A ROS package.

    Attributes:
        by: how it was found, as text.
    """

    folder: Path
    by: str

    def has(self, file: str) -> bool:
        """Whether the package contains a file."""
        return (self.folder / file).exists()


@dataclass(slots=True)
class Packages:
    """Finds the folders of ROS packages for one model.

    The order is: declarations of the user (``--package``, ``roots:`` of the twin), names of folders
    near the file, ``package.xml`` near the file, and last the ROS environment, which depends on the
    shell. Of several folders, the first that contains the referenced file is used.

    Attributes:
        above: folders above the model to search, nearest first.
        roots: other folders that may be packages or contain packages.
        given: package -> folder, from the command line.
        declared: package -> folder, from ``twin.yaml``.
        found: packages found so far: name -> package.
        renamed: beginning of a reference that names no package of this machine -> the package that
            it was taken for.
    """

    above: Sequence[Path] = ()
    roots: Sequence[Path] = ()
    given: Mapping[str, Path] = field(default_factory=dict)
    declared: Mapping[str, Path] = field(default_factory=dict)
    environment: Mapping[str, str] = field(default_factory=lambda: dict(os.environ))
    found: dict[str, FoundPackage] = field(default_factory=dict)
    renamed: dict[str, str] = field(default_factory=dict)

    def find(self, name: str, file: str) -> FoundPackage | None:
        """Find the folder of a package; None if it is not found.

        Args:
            file: path of the referenced file in the package.
        """
        first: FoundPackage | None = None
        for candidate in self._candidates(name, file):
            if candidate.has(file):
                self.found[name] = candidate
                return candidate
            first = first or candidate
        if first is not None:
            self.found.setdefault(name, first)
        return first

    def alike(self, name: str) -> str | None:
        """The only package near the model whose name differs in upper and lower case alone."""
        known = {other for other in self._names() if other.casefold() == name.casefold()} - {name}
        return known.pop() if len(known) == 1 else None

    def may_contain(self, path: Path) -> bool:
        """Whether a path is in a folder above the model, or in one that the user declares."""
        folders = (*self.above, *self.roots, *self.given.values(), *self.declared.values())
        return any(path.is_relative_to(folder) for folder in folders)

    def _names(self) -> Iterator[str]:
        yield from self.given
        yield from self.declared
        near = [candidate for top in self.above for candidate in (top, *_folders_in(top))]
        declared = [candidate for root in self.roots for candidate in (root, *_folders_in(root))]
        on_path = [
            candidate
            for entry in self._paths("ROS_PACKAGE_PATH")
            for candidate in (entry, *_folders_in(entry))
        ]
        shared = [
            candidate
            for prefix in self._paths("AMENT_PREFIX_PATH")
            for candidate in _folders_in(prefix / "share")
        ]
        for folder in (*near, *declared, *shared, *on_path):
            yield folder.name
        for folder in (*near, *on_path):
            yield package_name(folder) or ""

    def places(self) -> list[str]:
        """Descriptions of all searched places, for messages."""
        looked = [f"{folder} and its folders" for folder in (*self.above, *self.roots)]
        for variable in ("AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH"):
            value = self.environment.get(variable)
            looked.append(f"{variable}={value}" if value else f"{variable} (not set)")
        return looked

    def _candidates(self, name: str, file: str) -> Iterator[FoundPackage]:
        for by, known in ((BY_OPTION, self.given), (BY_TWIN, self.declared)):
            if name in known:
                yield FoundPackage(known[name], by)
        if not name or name in (".", ".."):
            return
        yield from self._above(name)
        for root in self.roots:
            for candidate in (root, root / name):
                if candidate.name == name and candidate.is_dir():
                    yield FoundPackage(candidate, BY_ROOT)
        yield from self._in_environment(name)
        for folder in self.above:
            if (folder / file).is_file():
                yield FoundPackage(folder, BY_FILE)

    def _above(self, name: str) -> Iterator[FoundPackage]:
        for folder in self.above:
            if folder.name == name:
                yield FoundPackage(folder, BY_NAME_ABOVE)
        for folder in self.above:
            beside = folder / name
            if beside.is_dir() and not beside.is_symlink():
                yield FoundPackage(beside, BY_NAME_BESIDE)
        for folder in self.above:
            for candidate in (folder, *_folders_in(folder)):
                if package_name(candidate) == name:
                    yield FoundPackage(candidate, BY_MANIFEST)

    def _in_environment(self, name: str) -> Iterator[FoundPackage]:
        for prefix in self._paths("AMENT_PREFIX_PATH"):
            if (prefix / "share" / name).is_dir():
                yield FoundPackage(prefix / "share" / name, BY_AMENT)
        for entry in self._paths("ROS_PACKAGE_PATH"):
            for candidate in (entry, *_folders_in(entry)):
                if candidate.name == name or package_name(candidate) == name:
                    yield FoundPackage(candidate, BY_ROS)
                elif candidate != entry and (candidate / name).is_dir():
                    yield FoundPackage(candidate / name, BY_ROS)

    def _paths(self, variable: str) -> list[Path]:
        listed = self.environment.get(variable, "").split(os.pathsep)
        paths = [Path(entry) for entry in listed if entry]
        return [path for path in paths if path.is_absolute() and path.is_dir()]


def package_name(folder: Path) -> str | None:
    """Name in the ``package.xml`` of a folder, or None."""
    file = folder / "package.xml"
    if not file.is_file():
        return None
    with suppress(TwinError):
        return (xml.parse(file).findtext("name") or "").strip() or None
    return None


def _folders_in(folder: Path) -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            found = [
                Path(entry.path)
                for entry in islice(entries, _MAX_ENTRIES)
                if entry.is_dir(follow_symlinks=False) and not entry.name.startswith(".")
            ]
    except OSError:
        return []
    return sorted(found)
