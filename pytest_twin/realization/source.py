"""What a realization was built from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pytest_twin.realization import urdf
from pytest_twin.realization.files.locate import Located
from pytest_twin.realization.node import Node


@dataclass(frozen=True, slots=True)
class Source:
    """What a realization was built from.

    Attributes:
        kind: ``mjcf`` or ``urdf``.
        root: the checked elements, includes spliced in.
        assets: name in the spec -> a file of each mesh, texture, or other asset; equal files share
            one name.
        read: files that were read beside those of ``root`` and ``assets``.
        urdf: the robot as read, None for MJCF.
        notes: what the conversion changed or left out, with file and line.
        inertia_repairs: link -> inertia (ixx iyy izz ixy ixz iyz, kg*m^2) that replaces one
            that no body can have, where such a repair was accepted.
        velocity_limit: joint -> rad/s or m/s.
        effects: the file of what is stepped beside the model, where a diagnosis wrote it.
        located: where its files may lie, and how its packages were found.
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
    located: Located | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that was read, sorted."""
        named = {node.path for node in self.root.walk()} | set(self.assets.values())
        beside = set() if self.effects is None else {self.effects}
        return tuple(sorted(named | self.read | beside))
