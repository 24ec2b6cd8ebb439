"""What a target of an export gives back, and the table of all targets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pytest_twin.asset.loss.matrix import Row

if TYPE_CHECKING:
    from pytest_twin.export.source import ExportSource

Checked = Literal["stepped", "loaded", "schema"]
"""How the written files were checked: stepped and compared, loaded, or compared with the schema."""


@dataclass(frozen=True, slots=True)
class Exported:
    """Result of an export.

    Attributes:
        files: names of the files for users, the main one first.
        engine: what read them back, with its version.
        checked: how they were checked in this run.
        rows: one row of the loss matrix for each effect and each setting.
        held_out: joint -> errors of the diagnosed and of the exported model, rad or m.
        notes: what a user must know.
    """

    files: tuple[str, ...]
    engine: str
    checked: Checked
    rows: tuple[Row, ...]
    held_out: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


TARGETS: Mapping[str, str] = {
    "mujoco": "pytest_twin.export.mujoco_target",
    "newton": "pytest_twin.export.newton",
    "mjlab": "pytest_twin.export.mjlab",
    "isaaclab": "pytest_twin.export.isaaclab",
    "playground": "pytest_twin.export.playground",
    "drake": "pytest_twin.export.drake",
}
"""Target -> module with a function ``export``."""

STEPPED = ("mjlab", "drake", "newton")
"""Targets whose own simulator can measure the loss."""


def exporter(target: str) -> Callable[[ExportSource, Path], Exported]:
    """The function that writes a target's files into an empty folder."""
    found: Callable[[ExportSource, Path], Exported] = import_module(TARGETS[target]).export
    return found
