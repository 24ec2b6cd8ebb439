"""Find the files that a URDF refers to, by the rules of ROS and of MuJoCo."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pytest_twin.errors import PathError
from pytest_twin.formats.paths import Roots
from pytest_twin.realization.files.packages import BY_FILE, Packages

_IN_PACKAGE = re.compile(r"(?:package|model)://+", re.IGNORECASE)
_FILE = re.compile(r"file://(?:localhost(?=/))?", re.IGNORECASE)
_FIND = re.compile(r"\$\(find\s+(?P<name>[^)\s]+)\s*\)/+(?P<rest>.+)", re.DOTALL)
"""What a xacro file says, in a URDF that was not expanded completely."""
_SHARE = re.compile(r"/(?:.*/)?share/+(?P<name>[^/]+)/+(?P<rest>.+)", re.DOTALL)
"""Path of an installed package: ``PREFIX/share/NAME/...``, of the machine that wrote the URDF."""


@dataclass(frozen=True, slots=True)
class MujocoFolders:
    """MuJoCo's settings for the mesh files of a URDF.

    Attributes:
        meshes: ``meshdir``, relative to the URDF.
        strip: ``strippath``: whether only the file name of a reference is used; None where it is
            not stated. MuJoCo 4 then uses the path, MuJoCo 3 used the name only.
        is_stated: whether the URDF states one of them in ``<mujoco><compiler/></mujoco>``.
    """

    meshes: str = ""
    strip: bool | None = None
    is_stated: bool = False

    @staticmethod
    def of(root: Any) -> MujocoFolders:
        """Read the settings below the ``robot`` element (any element with ``find``, attributes)."""
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
        """Paths that MuJoCo may open, relative to the URDF, the most probable first."""
        name = reference.replace("\\", "/").rpartition("/")[2]
        whole = [] if self.strip or "://" in reference else [reference]
        stripped = [] if self.strip is False else [name]
        return [str(Path(self.meshes) / path) for path in (*whole, *stripped)]


@dataclass(frozen=True, slots=True)
class UrdfFiles:
    """Finds the files that a URDF refers to.

    Attributes:
        roots: folders that may contain the files.
        packages: resolves ``package://`` references.
        mujoco: MuJoCo's settings in the URDF.
    """

    roots: Roots
    packages: Packages
    mujoco: MujocoFolders = MujocoFolders()

    @staticmethod
    def of(root: Any, roots: Roots, packages: Packages | None = None) -> UrdfFiles:
        """Create the finder for a ``robot`` element, with its settings for MuJoCo."""
        return UrdfFiles(roots, packages or Packages(), MujocoFolders.of(root))

    def path_of(self, reference: str, at: Path) -> Path:
        """Absolute path of a referenced file, without following links and without checks.

        If the URDF states MuJoCo's folders, the file there is used. Otherwise, or if it does not
        exist, the rules of ROS apply: relative to the URDF, or ``package://``. The path of an
        installed package on another machine is looked up in the package of its name here. The file
        that only MuJoCo would find comes last.

        Raises:
            PathError: its package is not found.
        """
        candidates = (at.parent / path for path in self.mujoco.paths(reference))
        by_mujoco = next((path for path in candidates if path.is_file()), None)
        if by_mujoco is not None and self.mujoco.is_stated:
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
        """Path of the file that the URDF ``at`` refers to as ``reference``.

        Args:
            reference: the reference as written.
            line, where: place in the URDF, for errors.

        Raises:
            PathError: its package is not found, or the file does not exist or is outside the roots.
        """
        try:
            path = str(self.path_of(reference, at)) if reference.strip() else reference
        except PathError as error:
            error.path, error.line, error.where, error.value = at, line, where, reference
            raise
        except (OSError, ValueError):
            # Not a valid file name; the error of `resolve` names it.
            path = reference
        return self.roots.resolve(path, at=at, line=line, where=where)

    def _by_ros(self, reference: str, at: Path) -> Path:
        scheme = _IN_PACKAGE.match(reference)
        if scheme is not None:
            name, _, rest = reference[scheme.end() :].partition("/")
            return self._in_package(name, rest.lstrip("/"), scheme[0] + name)
        if "://" in reference and not _FILE.match(reference):
            raise PathError("a URL, not a path", expected="a path, package:// or file://")
        text = _FILE.sub("", reference, count=1)
        path = at.parent / text
        elsewhere = _FIND.match(text) or _SHARE.match(text)
        if elsewhere is None or (
            path.exists() and (self.packages.may_contain(path) or self.roots.contains(path))
        ):
            return path
        return self._in_package(
            elsewhere["name"], elsewhere["rest"], text[: elsewhere.start("rest")].rstrip("/")
        )

    def _in_package(self, name: str, rest: str, beginning: str) -> Path:
        """Path of a file in a package.

        Args:
            name: name of the package, as written.
            rest: path of the file in the package, as written.
            beginning: the reference as written, up to and including the name.

        Raises:
            PathError: the package is not found.
        """
        package = self.packages.find(name, rest)
        is_here = package is not None and package.has(rest) and package.by != BY_FILE
        # Case has no meaning on some machines, and some exporters write the name twice.
        for known in () if is_here else (name, self.packages.alike(name)):
            for written in (rest, rest.removeprefix(f"{name}/")):
                other = None if known is None else self.packages.find(known, written)
                if other is None or known is None or not other.has(written) or other.by == BY_FILE:
                    continue
                self.packages.renamed[beginning if written == rest else f"{beginning}/{name}"] = (
                    known
                )
                if known != name:
                    self.packages.found.pop(name, None)
                return other.folder / written
        if package is None:
            raise PathError(
                f"package '{name}' is not found",
                expected=f"--package {name}=FOLDER, or a folder of that name; looked in "
                + ", ".join(self.packages.places()),
            )
        self.packages.found[name] = package
        if not beginning.endswith(f"://{name}"):
            self.packages.renamed[beginning] = name
        return package.folder / rest
