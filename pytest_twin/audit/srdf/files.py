"""Find the URDF of an SRDF, and the SRDFs of a URDF."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path

from pytest_twin.errors import ModelError, TwinError
from pytest_twin.formats import xml

_MOST_FILES = 200
"""Largest number of files examined in a folder."""
_URDF_FOLDERS = ("urdf", "robots", "robot", "")
_SRDF_FOLDERS = ("srdf", "config", "")
_PLANNING_SUFFIXES = ("_moveit_config", "_moveit2_config", "_moveit")
_ROBOT_SUFFIXES = ("_description", "_support", "")


def urdf_of(srdf: Path, name: str) -> Path:
    """Find the URDF of the robot ``name`` near its SRDF.

    The search covers the folder of the SRDF, folders ``urdf`` and ``robots`` next to and above it,
    and the description package next to a ``*_moveit_config`` package. A file with the name of the
    SRDF takes precedence over others that describe the same robot.

    Raises:
        ModelError: none, or several.
    """
    files = list(dict.fromkeys(_files(_urdf_folders(srdf), "*.urdf")))
    alike = [path for path in files if path.stem == srdf.stem]
    same = [path for path in alike or files if _robot(path) == name]
    found = same or alike
    if len(found) == 1:
        return found[0]
    folders = ", ".join(dict.fromkeys(str(folder) for folder in _urdf_folders(srdf)))
    if not found:
        raise ModelError(
            f"no URDF of the robot '{name}' in {folders}",
            path=srdf,
            expected="its URDF: --urdf FILE (a xacro file is expanded first: xacro FILE > FILE)",
        )
    raise ModelError(
        f"{len(found)} URDFs of the robot '{name}'",
        path=srdf,
        value=", ".join(str(path) for path in found[:6]),
        expected="one of them: --urdf FILE",
    )


def srdfs_of(urdf: Path, name: str) -> list[Path]:
    """Find the SRDFs of the robot ``name`` in the usual folders near its URDF."""
    files = dict.fromkeys(_files(_srdf_folders(urdf), "*.srdf"))
    return [path for path in files if path.stem == urdf.stem or _robot(path) == name]


def _urdf_folders(srdf: Path) -> list[Path]:
    found = [srdf.parent]
    for above in list(srdf.parent.parents)[:2]:
        found += [above / folder for folder in _URDF_FOLDERS]
        for suffix in _PLANNING_SUFFIXES:
            stem = above.name.removesuffix(suffix)
            if stem != above.name:
                for package in _ROBOT_SUFFIXES:
                    found += [above.parent / f"{stem}{package}" / part for part in _URDF_FOLDERS]
    return [folder for folder in dict.fromkeys(found) if folder.is_dir()]


def _srdf_folders(urdf: Path) -> list[Path]:
    found = [urdf.parent]
    for above in list(urdf.parent.parents)[:2]:
        found += [above / folder for folder in _SRDF_FOLDERS]
        stems = {above.name.removesuffix(suffix) for suffix in _ROBOT_SUFFIXES} | {urdf.stem}
        found += [
            above.parent / f"{stem}{suffix}" / "config"
            for stem in sorted(stems)
            for suffix in _PLANNING_SUFFIXES
        ]
    return [folder for folder in dict.fromkeys(found) if folder.is_dir()]


def _files(folders: list[Path], pattern: str) -> Iterator[Path]:
    for folder in folders:
        with suppress(OSError):
            yield from sorted(islice(folder.glob(pattern), _MOST_FILES))


def _robot(path: Path) -> str | None:
    """Return the name of the robot in a file; None if it cannot be read."""
    try:
        root = xml.parse(path)
    except (TwinError, OSError):
        return None
    return str(root.get("name", "")) if root.tag == "robot" else None
