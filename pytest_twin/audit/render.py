"""Draw shapes in three orthographic views, or as a small picture; each body has its own colour."""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.audit.asset import Asset, Shape, Vector
from pytest_twin.audit.geometry import Faces, triangles

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_VIEWS = (
    ("front", (1, 2), (1.0, 0.0, 0.0), ("y", "z")),
    ("side", (0, 2), (0.0, -1.0, 0.0), ("x", "z")),
    ("top", (1, 0), (0.0, 0.0, 1.0), ("-y", "x")),
)
"""Name, axes to the right and up, direction to the viewer; the front view is from +x."""
_LIGHT = np.array([0.45, -0.55, 0.7])
"""Direction to the lamp, world axes."""
_WIDTH, _HEIGHT, _GAP = 11.0, 4.2, 0.5
"""In inches: width of a picture, largest height of a view, space for labels."""
_DIM = "#5c6675"
_MOST_FACES = 40_000
"""Largest number of triangles in a picture; finer meshes are drawn with merged vertices."""
_FACES_PER_CELL = 8
"""Triangles of a sphere merged on a grid of n cells, divided by n squared; measured: 5 to 8."""
_LEAST_CELLS = 3
"""A shape with fewer cells along it is drawn as its bounding box."""
_Drawn = tuple[Shape, tuple[Vector, Faces]]
_OVERLAP = (0.85, 0.29, 0.20)
"""Colour (RGB) of bodies that overlap."""
_BASE = (0.74, 0.76, 0.78)
"""Colour (RGB) of the base."""
_SHADES = (
    (0.36, 0.55, 0.77),
    (0.45, 0.68, 0.66),
    (0.93, 0.74, 0.42),
    (0.60, 0.56, 0.77),
    (0.55, 0.74, 0.52),
    (0.50, 0.72, 0.86),
    (0.82, 0.62, 0.70),
)


def views(
    asset: Asset,
    values: Mapping[str, float],
    *,
    marked: Collection[str] = (),
) -> bytes | None:
    """Return a PNG of the collision shapes at a pose; None if there are none.

    Args:
        values: joint -> rad or m.
        marked: bodies to draw in red.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    shapes = [shape for shape in asset.shapes if shape.role == "collision"]
    corners, colours = drawn_triangles(asset, shapes, values, marked)
    if corners is None:
        return None
    low, high = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
    spans = np.maximum(high - low, 1e-3)
    corners, colours = split(corners, colours, float(spans.max()) / 30)
    margin = 0.05 * float(spans.max())
    sizes = [(spans[right] + 2 * margin, spans[up] + 2 * margin) for _, (right, up), _, _ in _VIEWS]
    # One scale for all three views, so that lengths can be compared.
    inch = min(
        (_WIDTH - 4 * 1.5 * _GAP) / sum(width for width, _ in sizes),
        _HEIGHT / max(height for _, height in sizes),
    )
    height = max(size[1] for size in sizes) * inch + 2 * _GAP
    with mpl.rc_context({"text.parse_math": False, "text.usetex": False, "font.size": 9}):
        figure = Figure(figsize=(_WIDTH, height), dpi=130)
        free = _WIDTH - sum(width for width, _ in sizes) * inch
        left = free / 4
        for (name, (right, up), toward, labels), size in zip(_VIEWS, sizes, strict=True):
            wide, tall = size[0] * inch, size[1] * inch
            axis = figure.add_axes(
                (left / _WIDTH, (height - tall) / 2 / height, wide / _WIDTH, tall / height),
                aspect="equal",
            )
            left += wide + free / 4
            sign = -1.0 if labels[0].startswith("-") else 1.0
            screen = np.array([sign * np.eye(3)[right], np.eye(3)[up]])
            paint(axis, corners, colours, screen, np.array(toward))
            ends = sorted((sign * low[right], sign * high[right]))
            axis.set_xlim(ends[0] - margin, ends[1] + margin)
            axis.set_ylim(low[up] - margin, high[up] + margin)
            axis.set_title(name, loc="left", color=_DIM, fontsize=10)
            axis.set_xlabel(f"{labels[0]} [m]", color=_DIM)
            axis.set_ylabel(f"{labels[1]} [m]", color=_DIM)
            axis.tick_params(colors=_DIM, labelsize=8)
            axis.xaxis.set_major_locator(MaxNLocator(max(2, min(6, int(wide / 0.55)))))
            axis.yaxis.set_major_locator(MaxNLocator(max(2, min(7, int(tall / 0.5)))))
            axis.grid(color="#e6eaef", linewidth=0.6)
            axis.set_axisbelow(True)
            for spine in axis.spines.values():
                spine.set_color("#d3d9e1")
        out = io.BytesIO()
        figure.savefig(out, format="png", facecolor="white")
    return out.getvalue()


def paint(axis: Axes, corners: Vector, colours: Vector, screen: Vector, toward: Vector) -> None:
    """Draw triangles, the farthest from the viewer first.

    Args:
        axis: in m.
        corners: (n, 3, 3) vertices, m.
        colours: (n, 3) RGB.
        screen: (2, 3) unit vectors to the right and up.
        toward: (3,) unit vector to the viewer.
    """
    from matplotlib.collections import PolyCollection

    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    order = np.argsort(corners.mean(axis=1) @ toward)
    shade = 0.62 + 0.25 * np.abs(normals @ toward) + 0.22 * np.abs(normals @ _LIGHT)
    # One array: matplotlib converts a list into paths one by one.
    flat: Any = (corners @ screen.T)[order]
    fill = np.clip(colours * np.minimum(shade, 1.1)[:, None], 0, 1)[order]
    axis.add_collection(PolyCollection(flat, facecolors=fill, edgecolors=fill, linewidths=0.3))


def drawn_triangles(
    asset: Asset, shapes: list[Shape], values: Mapping[str, float], marked: Collection[str]
) -> tuple[Vector | None, Vector]:
    """Triangles of a picture: (n, 3, 3) vertices in the root frame, m, and (n, 3) colours.

    Many or finely meshed shapes are simplified, so that a picture has a bounded number of them.

    Args:
        values: joint -> rad or m.
        marked: bodies to draw in red.

    Returns:
        None instead of vertices if no shape has a surface.
    """
    places = asset.at(values)
    number = {name: index for index, name in enumerate(asset.body)}
    found = [
        (shape, surface)
        for shape in shapes
        if shape.body in places and (surface := triangles(shape)) is not None
    ]
    corners: list[Vector] = []
    colours: list[Vector] = []
    for shape, (vertices, faces) in _limit_faces(found):
        if not len(faces):
            continue
        position, rotation = places[shape.body]
        corners.append((vertices @ rotation.T + position)[faces])
        colour = _SHADES[number[shape.body] % len(_SHADES)]
        if shape.body in marked:
            colour = _OVERLAP
        elif asset.group[shape.body] in asset.roots:
            colour = _BASE
        colours.append(np.tile(np.array(colour), (len(faces), 1)))
    if not corners:
        return None, np.zeros((0, 3))
    return np.concatenate(corners), np.concatenate(colours)


def _limit_faces(found: list[_Drawn]) -> list[_Drawn]:
    """Reduce surfaces to at most ``_MOST_FACES`` triangles.

    The grid is coarser, the more meshes there are. If that is not enough, the largest shapes are
    drawn as boxes and the others, which are smaller than a pixel, are omitted.
    """
    if sum(len(faces) for _, (_, faces) in found) <= _MOST_FACES:
        return found
    cells = math.isqrt(_MOST_FACES // (_FACES_PER_CELL * len(found)))
    if cells >= _LEAST_CELLS:
        return [(shape, coarse(*surface, min(cells, 40))) for shape, surface in found]
    largest = sorted(found, key=lambda one: -float(np.ptp(one[1][0], axis=0).max()))
    return [(shape, _box(vertices)) for shape, (vertices, _) in largest[: _MOST_FACES // 12]]


def _box(vertices: Vector) -> tuple[Vector, Faces]:
    """Return the axis-aligned bounding box of vertices."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [corner for a, b, c, d in sides for corner in ((a, b, c), (a, c, d))]
    return corners, np.array(faces, dtype=np.int32)


def coarse(vertices: Vector, faces: Faces, cells: int = 40) -> tuple[Vector, Faces]:
    """Merge a mesh's vertices on a grid of ``cells`` along its longest side."""
    low = vertices.min(axis=0)
    step = max(float(np.ptp(vertices, axis=0).max()) / cells, 1e-12)
    keys = np.floor((vertices - low) / step).astype(np.int64)
    _, inverse = np.unique(keys, axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    count = int(inverse.max()) + 1
    sums = np.zeros((count, 3))
    np.add.at(sums, inverse, vertices)
    merged = sums / np.bincount(inverse, minlength=count)[:, None]
    mapped: NDArray[np.int64] = inverse[faces]
    proper = (
        (mapped[:, 0] != mapped[:, 1])
        & (mapped[:, 1] != mapped[:, 2])
        & (mapped[:, 0] != mapped[:, 2])
    )
    mapped = mapped[proper]
    _, first = np.unique(np.sort(mapped, axis=1), axis=0, return_index=True)
    return merged, mapped[np.sort(first)].astype(np.int32)


def split(corners: Vector, colours: Vector, longest: float) -> tuple[Vector, Vector]:
    """Split (n, 3, 3) triangles until no side exceeds ``longest``, for correct depth sorting."""
    for _ in range(16):
        sides = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        worst = sides.argmax(axis=1)
        long = sides[np.arange(len(sides)), worst] > longest
        if not long.any() or len(corners) > 3 * _MOST_FACES:
            break
        picked, at = corners[long], worst[long]
        rows = np.arange(len(picked))
        a, b, c = (picked[rows, (at + k) % 3] for k in range(3))
        middle = (a + b) / 2
        halves = [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        corners = np.concatenate([corners[~long], *halves])
        colours = np.concatenate([colours[~long], colours[long], colours[long]])
    return corners, colours
