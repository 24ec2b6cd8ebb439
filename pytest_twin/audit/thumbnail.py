"""Draw a small picture of a robot, as browsers of assets show it; in the child process."""

from __future__ import annotations

import base64
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_twin.audit.asset import Asset, Vector
from pytest_twin.audit.read import read
from pytest_twin.audit.render import drawn_triangles

SIDE = 256
"""Width and height, px."""
_OVERSAMPLED = 2
"""The picture is drawn this many times larger, and averaged: edges are smooth."""
_MARGIN = 0.06
_VIEWER = np.array([1.0, -1.2, 0.8])
"""Direction from the robot to the viewer, base frame."""
_LIGHT = np.array([0.4, -0.5, 0.75])
_PAPER = (255, 255, 255)


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
            return png_bytes(_draw(corners, colours))
    return None


def _draw(corners: Vector, colours: Vector) -> NDArray[np.uint8]:
    """(SIDE, SIDE, 3) picture of (n, 3, 3) triangles [m] with (n, 3) colours, by a depth buffer."""
    toward = _VIEWER / np.linalg.norm(_VIEWER)
    right = np.cross([0.0, 0.0, 1.0], toward)
    right /= np.linalg.norm(right)
    views = corners @ np.stack([right, np.cross(toward, right), toward], axis=1)
    low, high = views.reshape(-1, 3).min(axis=0), views.reshape(-1, 3).max(axis=0)
    side = SIDE * _OVERSAMPLED
    scale = side * (1 - 2 * _MARGIN) / max(float((high - low)[:2].max()), 1e-9)
    flat = (views[..., :2] - (low + high)[:2] / 2) * scale * [1.0, -1.0] + side / 2
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    shade = 0.55 + 0.3 * np.abs(normals @ toward) + 0.2 * np.abs(normals @ _LIGHT)
    fill = np.clip(255 * colours * shade[:, None], 0, 255)
    picture = np.full((side, side, 3), _PAPER, dtype=np.float64)
    depth = np.full((side, side), -np.inf)
    for triangle, depths, colour in zip(flat, views[..., 2], fill, strict=True):
        _fill(triangle, depths, colour, picture, depth)
    blocks = picture.reshape(SIDE, _OVERSAMPLED, SIDE, _OVERSAMPLED, 3)
    pixels: NDArray[np.uint8] = blocks.mean(axis=(1, 3)).round().astype(np.uint8)
    return pixels


def _fill(triangle: Vector, depths: Vector, colour: Vector, picture: Vector, depth: Vector) -> None:
    """Draw one triangle, (3, 2) px, where it is in front of what is drawn already."""
    first = np.floor(triangle.min(axis=0)).astype(int)
    last = np.ceil(triangle.max(axis=0)).astype(int) + 1
    x, y = (np.arange(first[axis], last[axis]) + 0.5 for axis in (0, 1))
    (ax, ay), (bx, by), (cx, cy) = triangle
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if area == 0.0:
        return
    grid_x, grid_y = x[None, :], y[:, None]
    second = ((grid_x - ax) * (cy - ay) - (cx - ax) * (grid_y - ay)) / area
    third = ((bx - ax) * (grid_y - ay) - (grid_x - ax) * (by - ay)) / area
    along = depths[0] + second * (depths[1] - depths[0]) + third * (depths[2] - depths[0])
    window = (slice(first[1], last[1]), slice(first[0], last[0]))
    visible = (second >= 0) & (third >= 0) & (second + third <= 1) & (along > depth[window])
    depth[window][visible] = along[visible]
    picture[window][visible] = colour


def png_bytes(picture: NDArray[np.uint8]) -> bytes:
    """Return a PNG of a (height, width, 3) picture (https://www.w3.org/TR/png-3/)."""
    height, width, _ = picture.shape
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    # Each row starts with its filter, 0: none.
    rows = np.concatenate([np.zeros((height, 1), np.uint8), picture.reshape(height, -1)], axis=1)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 9)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )
