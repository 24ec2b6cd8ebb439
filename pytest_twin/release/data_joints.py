"""Compare the joints of data with those of a release: data of another robot must not be stamped."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pytest_twin.formats.stamps.joint_names import joint_names
from pytest_twin.recording_options import JointNames
from pytest_twin.release.statement import Release
from pytest_twin.words import list_names


@dataclass(frozen=True, slots=True)
class DataJoints:
    """Joints that data name, as the release names them.

    Attributes:
        known, unknown: those that the release has, and those that it lacks.
        released: joints of the release.
    """

    known: tuple[str, ...]
    unknown: tuple[str, ...]
    released: tuple[str, ...]

    @property
    def are_foreign(self) -> bool:
        """Whether the data name joints and the release has none of them."""
        return bool(self.unknown) and not self.known

    @property
    def note(self) -> str:
        """Joints that the release lacks, in words; empty if there are none."""
        return f"not joints of the release: {list_names(self.unknown)}" if self.unknown else ""


def compare_joints(path: Path, release: Release, stated: Mapping[str, str] | None) -> DataJoints:
    """Compare the joints of a data set or recording with those of a release.

    Args:
        path: file or folder that can store a stamp.
        stated: mapping of names, preferred to that of the release's ``twin.yaml``; None if the data
            are stated to name no joints.
    """
    released = _joints_of(release)
    if stated is None:
        return DataJoints((), (), released)
    names = JointNames.of(stated or _mapping_of(release))
    recorded = joint_names(path, released)
    renamed = [names.in_model(name, released) for name in recorded]
    return DataJoints(
        tuple(name for name in renamed if name in released),
        tuple(name for name, new in zip(recorded, renamed, strict=True) if new not in released),
        released,
    )


def _joints_of(release: Release) -> tuple[str, ...]:
    """Joints of all realizations, once each."""
    parts = (ident.partition(":") for ident in release.parts)
    return tuple(dict.fromkeys(name for layer, _, name in parts if layer.endswith("/joint")))


def _mapping_of(release: Release) -> Mapping[str, str]:
    part = release.parts.get("topics:recordings")
    return {} if part is None else part.content.get("joints") or {}
