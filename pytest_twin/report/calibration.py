"""The report of a calibration as a page."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import jinja2

from pytest_twin.calibration.boards.image_file import read_grey
from pytest_twin.errors import TwinError
from pytest_twin.report.calibration_plots import (
    covariance_figure,
    overlay_figure,
    residuals_figure,
    solvers_figure,
)
from pytest_twin.report.page import style_of, svg_uri, template

MOST_OVERLAYS = 6
"""Images that are shown, those with the largest reprojection error first."""

_VERDICT = {
    "accepted": ("Accepted: the held-out errors are within what the plan accepts", "good"),
    "rejected": ("Rejected", "bad"),
    "degenerate": ("Degenerate: the observations do not determine what was asked for", "bad"),
}


def render(document: Mapping[str, Any], images: Path) -> str:
    """The report as one HTML document without external files.

    Args:
        document: ``calibration.json``.
        images: folder that the images' paths are relative to.
    """
    style = style_of("report.css", "diagnosis.css")
    headline, mood = _VERDICT[document["verdict"]]
    seen = document.get("images", {})
    return _template().render(
        document=document,
        style=style.text,
        style_hash=style.sha256,
        headline=headline,
        mood=mood,
        overlays=_overlays(seen, images),
        residuals=svg_uri(residuals_figure(document)) if seen else None,
        solvers=svg_uri(solvers_figure(document)) if any(document["solvers"].values()) else None,
        ellipses=[
            (name, svg_uri(covariance_figure(record, name)))
            for name, record in document["records"].items()
            if "transform" in record and len(record["covariance"]) == 6
        ],
    )


def _overlays(seen: Mapping[str, Any], images: Path) -> list[tuple[str, str]]:
    worst = sorted(seen, key=lambda name: -seen[name]["reprojection_rms"])[:MOST_OVERLAYS]
    found = []
    for name in worst:
        one = seen[name]
        title = f"{name}: {one['reprojection_rms']:.3f} px, {len(one['corner_ids'])} corners"
        try:
            image = read_grey(images / one["file"])
        except TwinError:
            continue  # removed since; the page shows the others
        data = base64.b64encode(overlay_figure(image, one, title)).decode()
        found.append((title, f"data:image/png;base64,{data}"))
    return found


@cache
def _template() -> jinja2.Template:
    return template("calibration.html.j2")
