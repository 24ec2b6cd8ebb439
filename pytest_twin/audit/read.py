"""Read a URDF, MJCF or USD file into an :class:`Asset`."""

from __future__ import annotations

from pathlib import Path

from pytest_twin.audit import read_urdf
from pytest_twin.audit.asset import Asset
from pytest_twin.audit.finding import Place, finding_of
from pytest_twin.errors import ModelError
from pytest_twin.formats import xml
from pytest_twin.formats.declared_inputs import declared_inputs
from pytest_twin.realization.files.locate import ModelFolders, locate

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")


def read(path: Path, located: ModelFolders | None = None) -> Asset:
    """Read a URDF, MJCF or USD file for the audit.

    Args:
        path: the robot's file.
        located: folders for meshes and included files, where they are known already.

    Raises:
        TwinError: the file holds no robot that can be read.
    """
    path = path.parent.resolve() / path.name
    if path.suffix.lower() in USD_SUFFIXES:
        from pytest_twin.audit.read_usd import read as read_stage

        roots = declared_inputs().roots if located is None else located.roots.folders
        return read_stage(path, roots)
    tag = xml.parse(path).tag
    if tag == "robot":
        return _add_irregularities(read_urdf.read(path, located or locate(path)))
    if tag == "mujoco":
        from pytest_twin.audit.read_mjcf import read as read_model

        return _add_irregularities(read_model(path, located or locate(path)))
    raise ModelError(
        "not a robot model", path=path, line=1, value=str(tag), expected="<robot> or <mujoco>"
    )


def _add_irregularities(asset: Asset) -> Asset:
    """Add the file's violations of the XML standard to the asset's faults."""
    for found in xml.irregularities(asset.path):
        asset.faults.append(
            finding_of(
                "tree.not_well_formed",
                Place(asset.path, found.line),
                f"robot '{asset.name}'",
                title=f"not well-formed by the XML standard: {found.words}",
                settle="declare the prefix on the root element (xmlns:PREFIX=...)"
                if "prefix" in found.words
                else "write the comment without --",
            )
        )
    return asset
