"""MJCF for MuJoCo Playground: with the features of MJX alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pytest_twin.export.mujoco_target import MujocoExport
from pytest_twin.export.source import ExportSource
from pytest_twin.export.target import Exported


def export(source: ExportSource, folder: Path) -> Exported:
    """Write ``model.xml`` and one model for each controller into an empty folder.

    The loss is measured with MuJoCo, which has all features of MJX.

    Raises:
        TwinError: as :func:`pytest_twin.export.mujoco_target.export`.
    """
    exported = MujocoExport(source, for_mjx=True).write(folder)
    note = "checked with MuJoCo alone; MJX has single precision unless jax_enable_x64 is set"
    return replace(exported, notes=(*exported.notes, note))
