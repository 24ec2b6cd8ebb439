"""Run the complete audit of one file, in the child process."""

from __future__ import annotations

import base64
import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pytest_twin.audit import (
    commands,
    controllers,
    coupling,
    elements,
    evidence,
    finding,
    frames,
    inertia,
    installed_layers,
    joints,
    loads,
    meshes,
    mirrored,
    render,
    self_collision,
    sources,
    transmissions,
    tree,
)
from pytest_twin.audit.asset import Asset
from pytest_twin.audit.evidence import Evidence
from pytest_twin.audit.finding import LAYERS, SIMREADY, Finding
from pytest_twin.audit.geometry import Geometry
from pytest_twin.audit.read import read
from pytest_twin.audit.self_collision import PoseResult
from pytest_twin.audit.srdf import states
from pytest_twin.audit.srdf.document import Srdf
from pytest_twin.audit.srdf.files import srdfs_of
from pytest_twin.errors import TwinError
from pytest_twin.formats import atomic
from pytest_twin.realization import urdf
from pytest_twin.realization.files.locate import ModelFolders
from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings

_MOST_PICTURES = 6
"""Largest number of poses that are drawn, the first ones."""


def audit(asset: Asset, known: Evidence, geometry: Geometry) -> list[Finding]:
    """Return the findings of all layers that need no simulator; installed packages come last."""
    return [
        *asset.faults,
        *(_not_audited(asset, layer, why) for layer, why in asset.unseen.items()),
        *tree.check(asset),
        *joints.check(asset, known),
        *loads.check(asset),
        *evidence.check(asset, known),
        *coupling.check(asset),
        *transmissions.check(asset),
        *meshes.check(asset, geometry),
        *inertia.check(asset, geometry),
        *mirrored.check(asset, geometry),
        *frames.check(asset, known, geometry),
        *commands.check(asset, known),
        *controllers.check(asset),
        *elements.check(asset),
        *installed_layers.check(asset, known, geometry),
    ]


def _not_audited(asset: Asset, layer: str, why: str) -> Finding:
    return Finding(
        f"{layer}.not_looked_at",
        "unknown",
        asset.place,
        f"robot '{asset.name}'",
        f"this layer was not audited: {why}",
        why="it may hide further faults",
        settle="correct the critical findings, and run the audit again",
    )


def audit_file(
    path: str,
    evidence_path: str | None = None,
    progress: Callable[[float], None] | None = None,
) -> dict[str, Any]:
    """Return the JSON report of a file, with PNG pictures as base64 under ``renders``.

    Raises:
        TwinError: the file holds no robot that can be read.
    """
    say = progress or (lambda fraction: None)
    known = Evidence() if evidence_path is None else evidence.load(Path(evidence_path))
    with suppress_mujoco_warnings():
        asset = read(Path(path))
        say(0.4)
        geometry = Geometry(asset)
        findings = audit(asset, known, geometry)
        say(0.6)
        declared = {**_states_beside(asset), **known.poses}
        results, more = self_collision.measure(asset, geometry, declared)
    say(0.8)
    found = report(asset, geometry, [*findings, *more])
    found["poses"] = self_collision.to_json(results)
    plain: dict[str, Any] = atomic.without_non_finite(found)
    plain["renders"] = pictures(asset, results)
    plain["located"] = [] if asset.located is None else list(asset.located.words())
    say(1.0)
    return plain


def _states_beside(asset: Asset) -> dict[str, dict[str, float]]:
    """Return the named states of the SRDFs beside a URDF: ``group/state`` -> joint -> rad or m."""
    found: dict[str, dict[str, float]] = {}
    if asset.kind == "urdf":
        for path in srdfs_of(asset.path, asset.name):
            # The audit of the SRDF itself reports its faults.
            with contextlib.suppress(TwinError):
                found |= states.poses(Srdf(urdf.document(path), asset))
    return found


def findings_of(path: Path, located: ModelFolders | None = None) -> dict[str, Finding]:
    """Return id -> finding of a file, without those about distances at poses.

    Args:
        path: the robot's file.
        located: folders for meshes and included files, where they are known already.

    Raises:
        TwinError: the file holds no robot that can be read.
    """
    with suppress_mujoco_warnings():
        asset = read(path, located=located)
        return finding.by_id(audit(asset, Evidence(), Geometry(asset)))


def critical_findings(path: str) -> list[str]:
    """Return critical findings of a file, one line of text each: file, line, element and fault.

    Raises:
        TwinError: the file holds no robot that can be read.
    """
    return [
        ": ".join(str(word) for word in (one.place, one.element, one.title) if word)
        for one in findings_of(Path(path)).values()
        if one.severity == "critical"
    ]


def pictures(asset: Asset, results: list[PoseResult]) -> list[dict[str, str]]:
    """Draw the collision shapes at each measured pose, or the reference pose; PNG as base64."""
    shown = results or [PoseResult("as drawn", {}, (), 0, 0)]
    made = []
    for result in shown[:_MOST_PICTURES]:
        png = render.views(asset, result.values, marked=result.overlapping)
        if png is None:
            continue
        overlaps = sorted(result.overlapping)
        caption = "Collision shapes, one colour for each body."
        if overlaps:
            caption += f" Red: bodies that overlap another ({', '.join(overlaps[:12])})."
        elif result.near:
            nearest = result.near[0]
            caption += (
                f" Nearest: {nearest.first} and {nearest.second}, "
                f"{nearest.distance * 1e3:.3g} mm apart."
            )
        made.append(
            {
                "title": f"Pose: {result.name}",
                "caption": caption,
                "png": base64.b64encode(png).decode(),
            }
        )
    return made


def report(asset: Asset, geometry: Geometry, findings: list[Finding]) -> dict[str, Any]:
    """Return the report as JSON data."""
    free = coupling.degrees_of_freedom(asset)
    layers = [*LAYERS, *installed_layers.names()]
    if any(one.layer == SIMREADY for one in findings):
        layers.append(SIMREADY)
    common = finding.report_of(asset.path, asset.kind, asset.name, findings, layers)
    return {
        **common,
        "facts": {
            "bodies": len(asset.bodies),
            "frames_without_mass": len(frames.frame_bodies(asset)),
            "joints": len(asset.joints),
            "degrees_of_freedom": free.total,
            "independent": free.independent,
            "constrained": free.constrained,
            "followers": list(free.follower),
            "passive": list(free.passive),
            "sensed": list(free.sensed),
            "mass": {"value": sum(body.mass or 0.0 for body in asset.bodies), "unit": "kg"},
            "reach": {"value": asset.span, "unit": "m"},
            "files": [str(file) for file in asset.files],
            "srdf": [str(p) for p in srdfs_of(asset.path, asset.name)]
            if asset.kind == "urdf"
            else [],
            **({} if asset.located is None else asset.located.to_json()),
        },
        "sources": sources.findings_by_source(common["findings"]),
        "bodies": [
            {
                "body": row.body,
                "mass": {"value": row.mass, "unit": "kg"},
                "stated": row.is_stated,
                "principal_moments": {"value": list(row.moments), "unit": "kg*m^2"},
                "uniform_moments": {
                    "value": None if row.uniform is None else list(row.uniform),
                    "unit": "kg*m^2",
                },
                "hull_density": {"value": row.density, "unit": "kg/m^3"},
                "com_offset": {"value": row.com_offset, "unit": "m"},
            }
            for row in inertia.comparisons(asset, geometry)
        ],
        "meshes": [
            {
                "file": str(fact.file),
                "triangles": fact.faces,
                "extents": {"value": list(fact.extents), "unit": "m"},
                "watertight": fact.is_watertight,
                "volume": {"value": fact.volume, "unit": "m^3"},
                "hull_volume": {"value": fact.hull, "unit": "m^3"},
                "convexity": fact.convexity,
                "uses": list(fact.uses),
            }
            for fact in meshes.facts(asset, geometry)
        ],
    }
