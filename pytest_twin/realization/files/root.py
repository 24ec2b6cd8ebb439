"""Which folder is the root of a model: the files that the model names may lie only below it.

A model comes from a stranger. What it names is read, so it may name files of its own robot and no
others. The rules, from the nearest folder outwards:

- The folder of the model's file is always inside.
- A folder above it is inside where the model names a file that is there: the root is the nearest
  folder that holds every file that the model names.
- A ROS package is taken whole.
- Nothing is inside that lies above the package or the version-controlled checkout around the
  model, or above a folder that many projects or people share: the user's home, ``Downloads``,
  ``/tmp``, ``/usr``.
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
        mark: what makes it a boundary of its own: a ROS package (``package.xml``), a
            version-controlled checkout, or a source that ``pytest-twin intake`` keeps.
        shared: whether files of other projects or people lie in it.
    """

    path: Path
    mark: Mark | None = None
    shared: bool = False


@dataclass(frozen=True, slots=True)
class ModelRoot:
    """The folder that holds every file of a model.

    Attributes:
        why: the rule that chose it, as people read it.
    """

    folder: Path
    why: str


def inside(above: Sequence[Folder]) -> tuple[Folder, ...]:
    """The folders that could be the root, nearest first.

    Args:
        above: every folder above the model's file, nearest first.
    """
    own, *further = above
    allowed = [own, *takewhile(lambda folder: not folder.shared, further)]
    marked = [index for index, folder in enumerate(allowed) if folder.mark is not None]
    return tuple(allowed[: marked[-1] + 1] if marked else allowed)


def choose(
    above: Sequence[Folder], named: Iterable[Path], packages: Iterable[Path] = ()
) -> ModelRoot:
    """The root of a model.

    Args:
        above: every folder above the model's file, nearest first.
        named: absolute path of each file that the model names and that is there, as written: no
            link followed.
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
    return ModelRoot(common, "the nearest folder that holds every file that it names")


_REASONS: dict[Mark | None, str] = {
    "package": "its package, by package.xml",
    "checkout": "its version-controlled checkout",
    "intake": "the source that intake keeps",
}
