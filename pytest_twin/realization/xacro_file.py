"""Expand a xacro file; runs in a confined child, because its expressions are Python code."""

from __future__ import annotations

import os
import re
import sys
import types
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pytest_twin.errors import FormatError, PathError, SpecError, TwinError
from pytest_twin.formats.declared_inputs import declared_inputs
from pytest_twin.formats.links import stores
from pytest_twin.formats.paths import read_bytes
from pytest_twin.realization.files.packages import Packages
from pytest_twin.realization.files.root import inside
from pytest_twin.realization.files.surroundings import folders_above

ROS_VARIABLES = ("AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH")
_MAX_BYTES = 16 * 2**20
"""Largest size of a file that is searched for arguments and variables."""
_ARGUMENT = re.compile(rb"<xacro:arg\s[^>]*?\bname\s*=\s*[\"']([^\"']+)")
_VARIABLE = re.compile(rb"\b(?:opt)?env\s*[(\s]\s*[\"']?([A-Za-z_][A-Za-z0-9_]*)")
"""``$(env NAME)``, ``$(optenv NAME DEFAULT)`` and ``env('NAME')`` in ``$(eval ...)``."""


def readable_folders(path: Path, environment: Mapping[str, str]) -> list[Path]:
    """Folders that the child may read.

    They are those in which the packages of a model are searched, and those in which their links may
    end, such as the sources of a workspace.
    """
    declared = declared_inputs()
    named = [
        Path(entry)
        for variable in ROS_VARIABLES
        for entry in environment.get(variable, "").split(os.pathsep)
        if entry and Path(entry).is_dir()
    ]
    above = [inside(folders_above(file))[-1].path for file in (path, path.resolve())]
    folders = [*above, *declared.roots, *declared.packages.values(), *named]
    return [*folders, *(store for folder in folders for store in stores(folder / "link"))]


def expand(
    source: str,
    arguments: Mapping[str, str],
    environment: Mapping[str, str],
    variables: Iterable[str],
) -> dict[str, Any]:
    """Expand a xacro file.

    Args:
        arguments: name -> value of its ``xacro:arg``.
        environment: the user's variables that name folders of packages.
        variables: names of all variables of the user, whose values this process does not have.

    Returns:
        ``text`` of the URDF, the files that were ``read``, and ``packages``: name -> folder.

    Raises:
        PathError: a package is not found.
        SpecError: an argument that the file does not declare, or a variable of the environment.
        FormatError: xacro refuses the file.
    """
    import xacro

    path = Path(source)
    declared = declared_inputs()
    above = [folder.path for folder in inside(folders_above(path))]
    packages = Packages(above, declared.roots, declared.packages, environment=environment)
    failed: list[PathError] = []
    sys.modules.update(_package_index(packages, failed, path))
    # xacro changes the mapping: it adds the defaults of arguments that are not given.
    try:
        document = xacro.process_file(str(path), mappings=dict(arguments))
    except Exception as error:  # what xacro and the expressions of the file raise
        if failed:
            raise failed[0] from None
        raise _refusal(path, error, xacro.filestack) from None
    read = [Path(name).resolve() for name in dict.fromkeys((str(path), *xacro.all_includes))]
    _check_names(path, read, arguments, frozenset(variables))
    folders = {name: str(found.folder) for name, found in packages.found.items()}
    for element in (*document.getElementsByTagName("mesh"), *_textures(document)):
        _name_package(element, folders)
    text = document.documentElement.toprettyxml(indent="  ")
    return {"text": text, "read": [str(file) for file in read], "packages": folders}


def _package_index(
    packages: Packages, failed: list[PathError], path: Path
) -> dict[str, types.ModuleType]:
    """The module of ROS that xacro asks for the folder of a package, with our search."""

    def get_package_share_directory(name: str) -> str:
        package = packages.find(name, "")
        if package is None:
            failed.append(
                PathError(
                    f"package '{name}' is not found",
                    path=path,
                    where=f"$(find {name})",
                    expected=f"--package {name}=FOLDER, or a folder of that name; looked in "
                    + ", ".join(packages.places()),
                )
            )
            raise failed[-1]
        return str(package.folder)

    top = types.ModuleType("ament_index_python")
    inner = types.ModuleType("ament_index_python.packages")
    inner.get_package_share_directory = get_package_share_directory  # type: ignore[attr-defined]
    top.packages = inner  # type: ignore[attr-defined]
    return {top.__name__: top, inner.__name__: inner}


def _refusal(path: Path, error: Exception, files: Iterable[str | None] | None) -> TwinError:
    inner: BaseException = error
    while getattr(inner, "exc", None) is not None:
        inner = inner.exc  # type: ignore[attr-defined]
    at = next((Path(name) for name in reversed(list(files or ())) if name), path)
    words = " ".join(str(error).split()) or type(error).__name__
    if isinstance(inner, PermissionError):
        return PathError(
            f"xacro may not read a file: {words}",
            path=at,
            expected="files in the model's folders; to allow another folder: --root FOLDER",
        )
    return FormatError(
        f"xacro refuses it: {words}",
        path=at,
        expected="a file that xacro expands; --xacro ARG:=VALUE gives an argument",
    )


def _check_names(
    path: Path, read: Iterable[Path], arguments: Mapping[str, str], variables: frozenset[str]
) -> None:
    known: set[str] = set()
    for file in read:
        content = read_bytes(file, _MAX_BYTES)
        known |= {name.decode(errors="replace") for name in _ARGUMENT.findall(content)}
        for name in _VARIABLE.findall(content):
            if name.decode() in variables:
                raise SpecError(
                    "depends on a variable of the environment, which is set here",
                    path=file,
                    value=name.decode(),
                    expected=f"the robot without it (unset {name.decode()}), or the URDF that "
                    f"xacro writes: {command(path, arguments)}",
                )
    unknown = sorted(set(arguments) - known)
    if unknown:
        raise SpecError(
            "the file has no such argument",
            path=path,
            where="--xacro",
            value=unknown[0],
            expected=", ".join(sorted(known)) or "no argument",
        )


def command(path: Path, arguments: Mapping[str, str]) -> str:
    """The command of ROS that expands a file."""
    given = "".join(f" {name}:={value}" for name, value in arguments.items())
    return f"xacro {path.name}{given} > {path.name.split('.')[0]}.urdf"


def _textures(document: Any) -> list[Any]:
    return list(document.getElementsByTagName("texture"))


def _name_package(element: Any, folders: Mapping[str, str]) -> None:
    """Name the package, not its folder on this machine, in the path of a mesh or texture."""
    written = element.getAttribute("filename")
    file = written.removeprefix("file://")
    for name, folder in folders.items():
        if file.startswith(f"{folder}/"):
            element.setAttribute("filename", f"package://{name}{file.removeprefix(folder)}")
            return
