"""Copy a robot's files into a twin's folder, so that all references between them stay valid."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pytest_twin.errors import SpecError

ASSET = "asset"
_DEFAULT_NAME = "files"


@dataclass(frozen=True, slots=True)
class RobotFiles:
    """Files of a robot at their original place.

    Attributes:
        files: all files that were read, including the model.
        root: root folder of the model.
        packages: ROS package -> its folder.
        others: further folders from the user.
        asset: files of the asset that the model is a state of, its manifest first; empty if it has
            none.
    """

    model: Path
    files: Sequence[Path]
    root: Path
    packages: Mapping[str, Path] = field(default_factory=dict)
    others: Sequence[Path] = ()
    asset: Sequence[Path] = ()


@dataclass(frozen=True, slots=True)
class CopiedFiles:
    """Files of a robot in a twin's folder.

    Attributes:
        files: all files.
        roots: roots that ``twin.yaml`` must declare: name -> folder.
        manifest: manifest of the asset in the twin's folder; None without one.
    """

    model: Path
    files: list[Path]
    roots: dict[str, Path]
    manifest: Path | None = None


def copy_into_twin(robot: RobotFiles, folder: Path) -> CopiedFiles:
    """Copy the files of a robot that are outside the twin's folder to ``asset/``.

    The copy keeps the folders between the files of one root, and each package outside the root
    gets a folder with its name. Files that the model refers to by an absolute path are not copied;
    their folder is added to the roots. An asset with a manifest is copied whole, so that the twin
    keeps the link from the model to the supplier's files.

    Raises:
        SpecError: the folder for the asset exists already.
    """
    if all(path.is_relative_to(folder) for path in robot.files):
        wider = {} if robot.root == robot.model.parent else {_name(robot.root): robot.root}
        known = {**wider, **robot.packages}
        inside = {name: place for name, place in known.items() if place.is_relative_to(folder)}
        manifest = next(iter(robot.asset), None)
        return CopiedFiles(robot.model, list(robot.files), inside, manifest)
    fixed = [path for path in robot.files if _is_named_absolutely(path, robot)]
    in_asset = [path for path in robot.asset if path.is_file()]
    copied = [path for path in dict.fromkeys((*robot.files, *in_asset)) if path not in fixed]
    bases = _bases(robot, copied)
    asset = folder / ASSET
    places = {base: asset / name for base, name in bases.items()}
    for place in places.values():
        if place.exists():
            raise SpecError("the folder for the asset exists", path=place, expected="a new folder")
    moved = {path: _path_in_copy(path, places) for path in copied}
    staging = folder / f".{ASSET}-{os.getpid()}"
    try:
        for path, target in moved.items():
            copy = staging / target.relative_to(asset)
            copy.parent.mkdir(parents=True, exist_ok=True)
            # With its mode: the files of a source are read-only.
            shutil.copy(path, copy)
        asset.mkdir(parents=True, exist_ok=True)
        for name in bases.values():
            if (staging / name).exists():
                (staging / name).rename(asset / name)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    roots = {_name(robot.root): _path_in_copy(robot.root, places)}
    roots |= {
        name: _path_in_copy(package, places)
        for name, package in robot.packages.items()
        if any(package.is_relative_to(base) for base in places)
    }
    for path in fixed:
        roots.setdefault(_name(path.parent), path.parent)
    roots = {name: place for name, place in roots.items() if place.is_dir()}
    return CopiedFiles(
        moved[robot.model],
        [moved.get(path, path) for path in robot.files],
        roots,
        moved[robot.asset[0]] if robot.asset else None,
    )


def _bases(robot: RobotFiles, files: Sequence[Path]) -> dict[Path, str]:
    """Folders to copy -> name of the copy."""
    packages = {
        package: name
        for name, package in robot.packages.items()
        if any(path.is_relative_to(package) for path in files)
        and not package.is_relative_to(robot.root)
        and not (robot.asset and package.is_relative_to(robot.asset[0].parent))
        and not robot.model.is_relative_to(package)
    }
    rest = [path for path in files if not any(path.is_relative_to(base) for base in packages)]
    common = Path(os.path.commonpath([robot.root, *(path.parent for path in rest)]))
    taken = set(packages.values())
    name = _name(common)
    while name in taken:
        name += "_model"
    return {common: name, **packages}


def _path_in_copy(path: Path, places: Mapping[Path, Path]) -> Path:
    """Path of a file or folder in the copy, from the nearest copied folder above it."""
    above = [base for base in places if path.is_relative_to(base)]
    base = max(above, key=lambda folder: len(folder.parts))
    return places[base] / path.relative_to(base)


def _is_named_absolutely(path: Path, robot: RobotFiles) -> bool:
    """Whether the model refers to a file outside the root by its absolute path."""
    if path.is_relative_to(robot.root):
        return False
    if not any(path.is_relative_to(other) for other in robot.others):
        return False
    texts = (file for file in robot.files if file.suffix.lower() in (".urdf", ".xml", ".mjcf"))
    return any(str(path) in text.read_text(errors="replace") for text in texts)


def _name(folder: Path) -> str:
    """Name of a folder, with the characters allowed for a root in ``twin.yaml``."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", folder.name).lstrip(".-") or _DEFAULT_NAME
