"""Elements and files that a realization was built from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pytest_twin.realization import urdf
from pytest_twin.realization.files.locate import ModelFolders
from pytest_twin.realization.node import Node


@dataclass(frozen=True, slots=True)
class Source:
    """Elements and files that a realization was built from.

    Attributes:
        kind: ``mjcf`` or ``urdf``.
        root: the checked elements, with includes inserted.
        assets: name in the spec -> file of each mesh, texture or other asset; files with the same
            content share one name.
        read: further files that were read.
        urdf: the robot as read, None for MJCF.
        notes: changes and omissions of the conversion, with file and line.
        inertia_repairs: link -> inertia (ixx iyy izz ixy ixz iyz, kg*m^2) that replaces an
            inconsistent one, where such a repair was accepted.
        velocity_limit: joint -> rad/s or m/s.
        effects: file of the effects that a diagnosis added to the model, or None.
        located: folders that may contain its files, and how its packages were found.
    """

    kind: Literal["mjcf", "urdf"]
    root: Node
    assets: Mapping[str, Path]
    urdf: urdf.Robot | None = None
    notes: tuple[str, ...] = ()
    inertia_repairs: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    velocity_limit: Mapping[str, float] = field(default_factory=dict)
    read: frozenset[Path] = frozenset()
    effects: Path | None = None
    located: ModelFolders | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that were read, sorted."""
        named = {node.path for node in self.root.walk()} | set(self.assets.values())
        beside = set() if self.effects is None else {self.effects}
        return tuple(sorted(named | self.read | beside))
