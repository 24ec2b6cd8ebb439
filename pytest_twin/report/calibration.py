"""Write the report of a calibration as an HTML page."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pytest_twin.calibration.boards.image_file import read_grey
from pytest_twin.errors import TwinError
from pytest_twin.report.calibration_plots import (
    covariance_figure,
    overlay_figure,
    residuals_figure,
    scene_figure,
    solvers_figure,
    speeds_figure,
)
from pytest_twin.report.page import Page, svg_uri
from pytest_twin.report.text import printable

MOST_OVERLAYS = 6
"""Largest number of images on the page, largest reprojection errors first."""

_VERDICT = {
    "accepted": ("Accepted: the held-out errors are within what the plan accepts", "good"),
    "rejected": ("Rejected", "bad"),
    "degenerate": ("Degenerate: the observations do not determine a requested parameter", "bad"),
}


def render(document: Mapping[str, Any], images: Path) -> str:
    """Return the report as one HTML document without external files.

    Args:
        document: ``calibration.json``.
        images: base folder of the images' relative paths.
    """
    headline, mood = _VERDICT[document["verdict"]]
    seen = document.get("images", {})
    return _PAGE.render(
        document=document,
        headline=headline,
        conditions=conditions_of(document) if mood == "good" else [],
        mood=mood,
        estimates=list(_estimates(document["records"])),
        scene=svg_uri(scene_figure(document)) if "scene" in document else None,
        proposed=_proposed_poses(document),
        overlays=_overlays(seen, images),
        residuals=svg_uri(residuals_figure(document)) if seen else None,
        speeds=svg_uri(speeds_figure(document)) if "angular_speeds" in document else None,
        solvers=svg_uri(solvers_figure(document)) if any(document["solvers"].values()) else None,
        ellipses=[
            (name, svg_uri(covariance_figure(record, name)))
            for name, record in document["records"].items()
            if "transform" in record and len(record["covariance"]) == 6
        ],
    )


def conditions_of(document: Mapping[str, Any]) -> list[str]:
    """Return the conditions under which the records of ``calibration.json`` hold."""
    return list(
        dict.fromkeys(
            condition
            for record in document["records"].values()
            for condition in record.get("holds_if", ())
        )
    )


def _estimates(records: Mapping[str, Any]) -> Iterator[tuple[str, str, str, str, str]]:
    """Yield rows of record, coordinate, value, half of its 95 % interval, and unit."""
    scales = {"rad": (1e3, "mrad"), "m": (1e3, "mm"), "s": (1e3, "ms")}
    for name, record in records.items():
        title = printable(name.replace("_", " "))
        if "transform" in record:
            frames = printable(f"{record['parent']} to {record['child']}")
            for axis, value in zip("xyz", record["transform"]["xyz"], strict=True):
                width = (record["ci95"][axis][1] - record["ci95"][axis][0]) / 2.0
                yield title, f"{frames}: {axis}", f"{1e3 * value:.3f}", f"{1e3 * width:.3f}", "mm"
            if record["transform"]["quaternion_wxyz"] is None:
                continue
            words = ", ".join(f"{value:.5f}" for value in record["transform"]["quaternion_wxyz"])
            widths = ", ".join(f"{1e3 * record['ci95'][n][1]:.3f}" for n in ("rx", "ry", "rz"))
            yield title, f"{frames}: quaternion w x y z", words, widths, "1; mrad"
            continue
        for label, one in record.get("values", {"": record}).items():
            if "value" not in one:
                continue
            factor, unit = scales.get(one["unit"], (1.0, one["unit"]))
            width = factor * (one["ci95"][1] - one["ci95"][0]) / 2.0
            yield title, printable(label), f"{factor * one['value']:.4g}", f"{width:.2g}", unit


def _proposed_poses(document: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return heading and rows of the proposed poses, and their predicted gain."""
    found = document.get("next_poses", {})
    poses = found.get("poses", [])
    if not poses:
        return None
    if "joints" in poses[0]:
        names = [printable(name) for name in poses[0]["joints"]]
        rows = [list(one["joints"].values()) for one in poses]
    else:
        names = ["x", "y", "z", "qw", "qx", "qy", "qz"]
        rows = [one["flange"] for one in poses]
    now, then = (found[f"predictions_{when}"].get("translation") for when in ("now", "then"))
    return {
        "names": names,
        "rows": [
            ([f"{value:.3f}" for value in row], f"{one['information']:.1f}")
            for row, one in zip(rows, poses, strict=True)
        ],
        "now": None if now is None else f"{1e3 * now:.2f}",
        "then": None if then is None else f"{1e3 * then:.2f}",
    }


def _overlays(seen: Mapping[str, Any], images: Path) -> list[tuple[str, str]]:
    worst = sorted(seen, key=lambda name: -seen[name]["reprojection_rms"])[:MOST_OVERLAYS]
    found = []
    for name in worst:
        one = seen[name]
        title = f"{name}: {one['reprojection_rms']:.3f} px, {len(one['corner_ids'])} corners"
        try:
            image = read_grey(images / one["file"])
        except TwinError:
            continue  # the image was removed after the calibration; show the others
        data = base64.b64encode(overlay_figure(image, one, title)).decode()
        found.append((title, f"data:image/png;base64,{data}"))
    return found


_PAGE = Page("calibration.html.j2", "diagnosis.css")
