"""The files that a URDF names, found as ROS finds them, or as MuJoCo does."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pytest_twin.errors import PathError
from pytest_twin.formats.paths import Roots
from pytest_twin.realization.files.packages import Packages

_IN_PACKAGE = re.compile(r"(?:package|model)://+", re.IGNORECASE)
_FILE = re.compile(r"file://(?:localhost(?=/))?", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class MujocoFolders:
    """Where MuJoCo looks for the meshes of a URDF.

    Attributes:
        meshes: ``meshdir``, relative to the URDF.
        strip: ``strippath``: whether of a reference only the file's name counts; None where the
            URDF does not say. MuJoCo 4 then keeps the path, and MuJoCo 3 took the name alone.
        stated: whether the URDF says either, in ``<mujoco><compiler/></mujoco>``.
    """

    meshes: str = ""
    strip: bool | None = None
    stated: bool = False

    @staticmethod
    def of(root: Any) -> MujocoFolders:
        """What the ``robot`` element (an element with ``find`` and attributes) says."""
        block = root.find("mujoco")
        compiler = None if block is None else block.find("compiler")
        if compiler is None:
            return MujocoFolders()
        said = getattr(compiler, "attributes", None) or dict(compiler.attrib)
        folder = said.get("meshdir", said.get("assetdir"))
        return MujocoFolders(
            folder or "",
            said["strippath"].strip() == "true" if "strippath" in said else None,
            folder is not None or "strippath" in said,
        )

    def paths(self, reference: str) -> list[str]:
        """The paths that MuJoCo opens, relative to the URDF, the likelier first."""
        name = reference.replace("\\", "/").rpartition("/")[2]
        whole = [] if self.strip or "://" in reference else [reference]
        stripped = [] if self.strip is False else [name]
        return [str(Path(self.meshes) / path) for path in (*whole, *stripped)]


@dataclass(frozen=True, slots=True)
class UrdfFiles:
    """Finds the files that a URDF names."""

    roots: Roots
    packages: Packages
    mujoco: MujocoFolders = MujocoFolders()

    @staticmethod
    def of(root: Any, roots: Roots, packages: Packages | None = None) -> UrdfFiles:
        """Those of a ``robot`` element, which may state MuJoCo's folders."""
        return UrdfFiles(roots, packages or Packages(), MujocoFolders.of(root))

    def path_of(self, reference: str, at: Path) -> Path:
        """The path that a reference means, absolute; no link is followed, nothing is checked.

        A URDF that states MuJoCo's folders means these. Where there is no such file it is taken as
        ROS takes it: relative to the URDF, or ``package://``. A file of that name beside the URDF,
        which MuJoCo alone would find, comes last.

        Raises:
            PathError: its package is not found.
        """
        candidates = (at.parent / path for path in self.mujoco.paths(reference))
        by_mujoco = next((path for path in candidates if path.is_file()), None)
        if by_mujoco is not None and self.mujoco.stated:
            return by_mujoco
        try:
            by_ros = self._by_ros(reference, at)
        except PathError:
            if by_mujoco is None:
                raise
            return by_mujoco
        return by_mujoco if by_mujoco is not None and not by_ros.exists() else by_ros

    def find(
        self, reference: str, *, at: Path, line: int | None = None, where: str | None = None
    ) -> Path:
        """The file that ``reference`` names in the URDF ``at``.

        Raises:
            PathError: its package is not found; or it leaves the roots, or is no file.
        """
        try:
            path = str(self.path_of(reference, at)) if reference.strip() else reference
        except PathError as error:
            error.path, error.line, error.where, error.value = at, line, where, reference
            raise
        except (OSError, ValueError):
            # No name that a file can have: the roots say which.
            path = reference
        return self.roots.resolve(path, at=at, line=line, where=where)

    def _by_ros(self, reference: str, at: Path) -> Path:
        scheme = _IN_PACKAGE.match(reference)
        if scheme is not None:
            name, _, rest = reference[scheme.end() :].partition("/")
            rest = rest.lstrip("/")
            package = self.packages.find(name, rest)
            if package is None:
                raise PathError(
                    f"package '{name}' is not found",
                    expected=f"--package {name}=FOLDER, or a folder of that name; looked in "
                    + ", ".join(self.packages.places()),
                )
            return package.folder / rest
        if "://" in reference and not _FILE.match(reference):
            raise PathError("a URL, not a path", expected="a path, package:// or file://")
        return at.parent / _FILE.sub("", reference, count=1)
