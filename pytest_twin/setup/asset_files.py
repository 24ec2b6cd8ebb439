"""Bring a robot's files into a twin's folder, so that every reference between them holds."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pytest_twin.errors import SpecError

ASSET = "asset"
_NAMELESS = "files"


@dataclass(frozen=True, slots=True)
class RobotFiles:
    """What a robot is made of, where it lies.

    Attributes:
        model: the robot's file.
        files: every file that was read, the model's own too.
        root: the folder that references lead into.
        packages: ROS package -> its folder.
        others: further folders that the user names.
    """

    model: Path
    files: Sequence[Path]
    root: Path
    packages: Mapping[str, Path] = field(default_factory=dict)
    others: Sequence[Path] = ()


@dataclass(frozen=True, slots=True)
class Brought:
    """A robot in a twin's folder.

    Attributes:
        roots: what ``twin.yaml`` declares: name -> folder.
    """

    model: Path
    files: list[Path]
    roots: dict[str, Path]


def bring_in(robot: RobotFiles, folder: Path) -> Brought:
    """The robot in the twin's folder; what lies outside is copied to ``asset/``.

    A copy keeps the folders between the files of one root, and each package outside of it gets a
    folder of its own name. Files that the model names by an absolute path stay where they are:
    their folder is declared.

    Raises:
        SpecError: the asset's place is taken.
    """
    if all(path.is_relative_to(folder) for path in robot.files):
        wider = {} if robot.root == robot.model.parent else {_name(robot.root): robot.root}
        known = {**wider, **robot.packages}
        inside = {name: place for name, place in known.items() if place.is_relative_to(folder)}
        return Brought(robot.model, list(robot.files), inside)
    fixed = [path for path in robot.files if _is_named_absolutely(path, robot)]
    copied = [path for path in robot.files if path not in fixed]
    bases = _bases(robot, copied)
    asset = folder / ASSET
    places = {base: asset / name for base, name in bases.items()}
    for place in places.values():
        if place.exists():
            raise SpecError("the asset's place is taken", path=place, expected="a new folder")
    moved = {path: _moved(path, places) for path in copied}
    staging = folder / f".{ASSET}-{os.getpid()}"
    try:
        for path, target in moved.items():
            copy = staging / target.relative_to(asset)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)
        asset.mkdir(parents=True, exist_ok=True)
        for name in bases.values():
            if (staging / name).exists():
                (staging / name).rename(asset / name)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    roots = {_name(robot.root): _moved(robot.root, places)}
    roots |= {
        name: _moved(package, places)
        for name, package in robot.packages.items()
        if any(package.is_relative_to(base) for base in places)
    }
    for path in fixed:
        roots.setdefault(_name(path.parent), path.parent)
    roots = {name: place for name, place in roots.items() if place.is_dir()}
    return Brought(moved[robot.model], [moved.get(path, path) for path in robot.files], roots)


def _bases(robot: RobotFiles, files: Sequence[Path]) -> dict[Path, str]:
    """Each folder that is copied with what is below it, and the name of its copy."""
    packages = {
        package: name
        for name, package in robot.packages.items()
        if any(path.is_relative_to(package) for path in files)
        and not package.is_relative_to(robot.root)
        and not robot.model.is_relative_to(package)
    }
    rest = [path for path in files if not any(path.is_relative_to(base) for base in packages)]
    common = Path(os.path.commonpath([robot.root, *(path.parent for path in rest)]))
    taken = set(packages.values())
    name = _name(common)
    while name in taken:
        name += "_model"
    return {common: name, **packages}


def _moved(path: Path, places: Mapping[Path, Path]) -> Path:
    """Where a file or folder lies in the copy: by the nearest base above it."""
    above = [base for base in places if path.is_relative_to(base)]
    base = max(above, key=lambda folder: len(folder.parts))
    return places[base] / path.relative_to(base)


def _is_named_absolutely(path: Path, robot: RobotFiles) -> bool:
    """Whether a file outside the root is named by its absolute path, which no copy could keep."""
    if path.is_relative_to(robot.root):
        return False
    if not any(path.is_relative_to(other) for other in robot.others):
        return False
    texts = (file for file in robot.files if file.suffix.lower() in (".urdf", ".xml", ".mjcf"))
    return any(str(path) in text.read_text(errors="replace") for text in texts)


def _name(folder: Path) -> str:
    """The name of a folder, as ``twin.yaml`` takes it for a root."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", folder.name).lstrip(".-") or _NAMELESS
