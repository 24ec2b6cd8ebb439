"""Draw a small picture of a robot, as browsers of assets show it; in the child process."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import numpy as np

from pytest_twin.audit.asset import Asset, Vector
from pytest_twin.audit.read import read
from pytest_twin.audit.render import drawn_triangles, paint, split

SIDE = 256
"""Width and height, px."""
_MARGIN = 0.06
_VIEWER = np.array([1.0, -1.2, 0.8])
"""Direction from the robot to the viewer, base frame."""


def thumbnail_of_file(path: str) -> str | None:
    """Return a PNG of a robot's file as base64; None without visible shapes."""
    png = thumbnail(read(Path(path)))
    return None if png is None else base64.b64encode(png).decode()


def thumbnail(asset: Asset) -> bytes | None:
    """Return a PNG of the robot's visual shapes, or its collision shapes; None without any."""
    for role in ("visual", "collision"):
        shapes = [shape for shape in asset.shapes if shape.role == role]
        corners, colours = drawn_triangles(asset, shapes, {}, ())
        if corners is not None:
            return _draw(corners, colours)
    return None


def _draw(corners: Vector, colours: Vector) -> bytes:
    """PNG of (n, 3, 3) triangles [m] with (n, 3) colours."""
    from matplotlib.figure import Figure

    toward = _VIEWER / np.linalg.norm(_VIEWER)
    right = np.cross([0.0, 0.0, 1.0], toward)
    right /= np.linalg.norm(right)
    screen = np.stack([right, np.cross(toward, right)])
    flat = (corners @ screen.T).reshape(-1, 2)
    low, high = flat.min(axis=0), flat.max(axis=0)
    middle, size = (low + high) / 2, max(float((high - low).max()), 1e-9)
    half = size / 2 / (1 - 2 * _MARGIN)
    figure = Figure(figsize=(1.0, 1.0), dpi=SIDE)
    axis = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axis.set_axis_off()
    axis.set_xlim(middle[0] - half, middle[0] + half)
    axis.set_ylim(middle[1] - half, middle[1] + half)
    paint(axis, *split(corners, colours, size / 30), screen, toward)
    out = io.BytesIO()
    figure.savefig(out, format="png", facecolor="white")
    return out.getvalue()
