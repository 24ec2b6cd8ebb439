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
        strip: ``strippath``: of a reference only the file's name counts.
        stated: whether the URDF says either, in ``<mujoco><compiler/></mujoco>``.
    """

    meshes: str = ""
    strip: bool = True
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
            said.get("strippath", "true").strip() != "false",
            folder is not None or "strippath" in said,
        )

    def path(self, reference: str) -> str:
        """The path that MuJoCo opens, relative to the URDF."""
        if self.strip:
            reference = reference.replace("\\", "/").rpartition("/")[2]
        return str(Path(self.meshes) / reference)


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
        folder = at.parent
        by_mujoco = folder / self.mujoco.path(reference)
        if self.mujoco.stated and by_mujoco.exists():
            return by_mujoco
        try:
            by_ros = self._by_ros(reference, at)
        except PathError:
            if by_mujoco.is_file():
                return by_mujoco
            raise
        if not by_ros.exists() and by_mujoco.is_file():
            return by_mujoco
        return by_ros

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
