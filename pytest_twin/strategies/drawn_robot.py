"""A drawn robot, and its files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

from pytest_twin.formats import atomic
from pytest_twin.strategies import robot_text
from pytest_twin.strategies.drawn import DrawnJoint, DrawnLink


@dataclass(frozen=True)
class DrawnRobot:
    """A robot that stands fixed: ``links[0]`` is its base."""

    name: str
    links: tuple[DrawnLink, ...]
    joints: tuple[DrawnJoint, ...]

    @cached_property
    def urdf(self) -> str:
        """Its URDF; meshes are named relative to the file."""
        return robot_text.urdf(self.name, self.links, self.joints)

    @cached_property
    def mjcf(self) -> str:
        """Its MJCF: the same bodies, joints, motors bounded by the effort, mimic as equality."""
        return robot_text.mjcf(self.name, self.links, self.joints)

    @property
    def meshes(self) -> Mapping[str, bytes]:
        """File name -> STL."""
        return {
            shape.file: robot_text.wedge(shape.size)
            for link in self.links
            for shape in link.shapes
            if shape.kind == "mesh"
        }

    def write(self, folder: Path, form: Literal["urdf", "mjcf"] = "urdf") -> Path:
        """Write it with its meshes into an existing folder; returns the model's file."""
        for name, data in self.meshes.items():
            atomic.write_bytes(folder / name, data)
        path = folder / f"{self.name}.{'urdf' if form == 'urdf' else 'xml'}"
        atomic.write_text(path, self.urdf if form == "urdf" else self.mjcf)
        return path
