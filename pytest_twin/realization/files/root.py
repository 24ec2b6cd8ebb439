"""Choose the root folder of a model, which must contain all files that the model refers to.

A model may come from an untrusted source. Its referenced files are read, so that only files of the
robot itself may be allowed. The rules, from the nearest folder outwards:

- The root contains at least the folder of the model's file.
- The root is the nearest folder that contains all existing files that the model refers to.
- If it is inside a ROS package, the root is the whole package.
- The root is never above the package or the version-controlled checkout that contains the model,
  nor a folder that many projects or people share: the user's home, ``Downloads``, ``/tmp``,
  ``/usr``.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Literal

Mark = Literal["package", "checkout", "intake"]


@dataclass(frozen=True, slots=True)
class Folder:
    """A folder above a model.

    Attributes:
        mark: kind of boundary: a ROS package (``package.xml``), a version-controlled checkout, or
            a source that ``pytest-twin intake`` keeps; None for an ordinary folder.
        is_shared: whether it contains files of other projects or people.
    """

    path: Path
    mark: Mark | None = None
    is_shared: bool = False


@dataclass(frozen=True, slots=True)
class ModelRoot:
    """The folder that contains all files of a model.

    Attributes:
        why: the rule that chose it, as text.
    """

    folder: Path
    why: str


def inside(above: Sequence[Folder]) -> tuple[Folder, ...]:
    """Folders that may be the root, nearest first.

    Args:
        above: all folders above the model's file, nearest first.
    """
    own, *further = above
    allowed = [own, *takewhile(lambda folder: not folder.is_shared, further)]
    marked = [index for index, folder in enumerate(allowed) if folder.mark is not None]
    return tuple(allowed[: marked[-1] + 1] if marked else allowed)


def choose(
    above: Sequence[Folder], named: Iterable[Path], packages: Iterable[Path] = ()
) -> ModelRoot:
    """Choose the root of a model.

    Args:
        above: all folders above the model's file, nearest first.
        named: absolute paths of existing files that the model refers to, without following links.
        packages: folders above the model that its ``package://`` references name.
    """
    allowed = inside(above)
    own, outermost = allowed[0].path, allowed[-1].path
    paths = [Path(os.path.normpath(path)) for path in named]
    held = [path for path in paths if path.is_relative_to(outermost)]
    common = next(
        folder.path for folder in allowed if all(path.is_relative_to(folder.path) for path in held)
    )
    reasons = {
        folder.path: _REASONS[folder.mark]
        for folder in allowed
        if folder.mark in ("package", "intake")
    }
    reasons |= {folder: f"its package, by the folder's name {folder.name!r}" for folder in packages}
    for folder in allowed:
        if folder.path in reasons and common.is_relative_to(folder.path):
            return ModelRoot(folder.path, reasons[folder.path])
    if common == own:
        return ModelRoot(own, "the folder of its file")
    if any(folder.path == common and folder.mark == "checkout" for folder in allowed):
        return ModelRoot(common, _REASONS["checkout"])
    return ModelRoot(common, "the nearest folder with all files that it refers to")


_REASONS: dict[Mark | None, str] = {
    "package": "its package, by package.xml",
    "checkout": "its version-controlled checkout",
    "intake": "the source that intake keeps",
}
