"""A random robot, and its files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

from pytest_twin.formats import atomic
from pytest_twin.strategies import robot_text
from pytest_twin.strategies.robot_elements import DrawnJoint, DrawnLink


@dataclass(frozen=True)
class DrawnRobot:
    """A random robot with a fixed base, which is ``links[0]``."""

    name: str
    links: tuple[DrawnLink, ...]
    joints: tuple[DrawnJoint, ...]

    @cached_property
    def urdf(self) -> str:
        """URDF of the robot; mesh files are relative to it."""
        return robot_text.urdf(self.name, self.links, self.joints)

    @cached_property
    def mjcf(self) -> str:
        """MJCF of the robot: the same bodies and joints, limited motors, mimic as equality."""
        return robot_text.mjcf(self.name, self.links, self.joints)

    @property
    def meshes(self) -> Mapping[str, bytes]:
        """File name -> content of the STL file."""
        return {
            shape.file: robot_text.wedge(shape.size)
            for link in self.links
            for shape in link.shapes
            if shape.kind == "mesh"
        }

    def write(self, folder: Path, form: Literal["urdf", "mjcf"] = "urdf") -> Path:
        """Write the robot and its meshes into an existing folder; the path of the model file."""
        for name, data in self.meshes.items():
            atomic.write_bytes(folder / name, data)
        path = folder / f"{self.name}.{'urdf' if form == 'urdf' else 'xml'}"
        atomic.write_text(path, self.urdf if form == "urdf" else self.mjcf)
        return path
