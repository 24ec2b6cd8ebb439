"""Write the metadata of a stage that NVIDIA's SimReady asks for, as a JSON file beside it.

Beside it and not in it: the date of the conversion would change the digest of the stage.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pytest_twin.errors import TwinError
from pytest_twin.formats import atomic, xml
from pytest_twin.formats.paths import Roots

NOT_STATED = "not stated by the supplier"
_ROBOT = "Q11012"
"""Wikidata's item of the category robot."""


def write(stage: Path, source: Path, roots: Roots) -> Path:
    """Write ``NAME.json`` beside ``NAME.usdc``, and return it.

    Author and licence are those of the ROS package that the source is in.

    Args:
        source: the supplier's file.
        roots: folders that may be searched for ``package.xml``.
    """
    author, licence = _package(source, roots)
    path = stage.with_suffix(".json")
    metadata: dict[str, Any] = {
        "asset_name": stage.stem,
        "asset_type": "robot",
        "category": "robot",
        "qcode": _ROBOT,
        "author": author or NOT_STATED,
        "asset_license": licence or NOT_STATED,
        "source_file": source.name,
        "usd_date_generated": _today(),
        **_measures(stage),
    }
    text = json.dumps(metadata, indent=1, ensure_ascii=False, allow_nan=False)
    atomic.write_text(path, text + "\n")
    return path


def _package(source: Path, roots: Roots) -> tuple[str | None, str | None]:
    """Authors and licences in the nearest ``package.xml``; None if it states none."""
    for folder in source.parents:
        if not roots.contains(folder):
            break
        if not (folder / "package.xml").is_file():
            continue
        with suppress(TwinError):
            package = xml.parse(folder / "package.xml")
            persons = [*package.iter("author")] or [*package.iter("maintainer")]
            stated = (persons, [*package.iter("license")])
            author, licence = (
                ", ".join(text for element in elements if (text := (element.text or "").strip()))
                for elements in stated
            )
            return author or None, licence or None
    return None, None


def _today() -> str:
    """Date of the conversion; ``SOURCE_DATE_EPOCH`` sets it (reproducible-builds.org)."""
    stated = os.environ.get("SOURCE_DATE_EPOCH", "")
    moment = datetime.fromtimestamp(int(stated), UTC) if stated.isdigit() else datetime.now(UTC)
    return moment.date().isoformat()


def _measures(stage_path: Path) -> dict[str, Any]:
    """Number of rigid bodies, mass [kg], and (3,) size of the bounding box at the zero pose [m]."""
    from pxr import Usd, UsdGeom, UsdPhysics

    stage = Usd.Stage.Open(str(stage_path))
    bodies, mass = 0, 0.0
    for prim in stage.Traverse():
        bodies += prim.HasAPI(UsdPhysics.RigidBodyAPI)
        if prim.HasAPI(UsdPhysics.MassAPI):
            mass += UsdPhysics.MassAPI(prim).GetMassAttr().Get() or 0.0
    purposes = [UsdGeom.Tokens.default_, UsdGeom.Tokens.render, UsdGeom.Tokens.guide]
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), purposes)
    size = cache.ComputeWorldBound(stage.GetDefaultPrim()).ComputeAlignedRange().GetSize()
    return {
        "rigid_body_count": bodies,
        "mass": round(mass, 6),
        "asset_extents": [round(max(side, 0.0), 6) for side in size],
    }
