"""Describe a collision shape by kind and bounding box, which every simulator provides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Shape:
    """One collision shape. Planes and height fields are ground, not a part of a robot.

    Attributes:
        kind: ``box``, ``sphere``, ``ellipsoid``, ``cylinder``, ``capsule``, ``mesh`` or
            ``convex hull``.
        lower, upper: (3,) corners of its bounding box along the link's axes, m.
    """

    kind: str
    lower: Vector
    upper: Vector

    def __str__(self) -> str:
        size = " x ".join(f"{value:.4g}" for value in self.upper - self.lower)
        centre = " ".join(f"{value:.4g}" for value in (self.upper + self.lower) / 2)
        return f"{self.kind}, {size} m around {centre}"

    def apart(self, other: Shape) -> float:
        """Return the largest distance between corners of the two boxes along an axis, m."""
        return float(
            max(np.abs(self.lower - other.lower).max(), np.abs(self.upper - other.upper).max())
        )


def of_points(kind: str, points: Vector, pose: Vector) -> Shape:
    """A shape of vertices (n, 3) in its own frame, with ``pose`` (4, 4) in the link."""
    placed = points @ pose[:3, :3].T + pose[:3, 3]
    return Shape(kind, placed.min(axis=0), placed.max(axis=0))


def of_box(size: Vector, pose: Vector) -> Shape:
    """``size`` (3,) full lengths, m."""
    half = np.abs(pose[:3, :3]) @ (np.asarray(size) / 2)
    return Shape("box", pose[:3, 3] - half, pose[:3, 3] + half)


def of_sphere(radius: float, pose: Vector) -> Shape:
    """``radius`` in m."""
    return Shape("sphere", pose[:3, 3] - radius, pose[:3, 3] + radius)


def of_ellipsoid(radii: Vector, pose: Vector) -> Shape:
    """``radii`` (3,) half axes, m."""
    half = np.linalg.norm(pose[:3, :3] * np.asarray(radii), axis=1)
    return Shape("ellipsoid", pose[:3, 3] - half, pose[:3, 3] + half)


def of_round(kind: str, radius: float, length: float, pose: Vector) -> Shape:
    """A cylinder, or a capsule with ``length`` between its half spheres; along z; m."""
    axis = np.abs(pose[:3, 2])
    if kind == "capsule":
        half = axis * length / 2 + radius
    else:
        half = axis * length / 2 + radius * np.sqrt(np.maximum(0.0, 1.0 - axis**2))
    return Shape(kind, pose[:3, 3] - half, pose[:3, 3] + half)


def in_order(shapes: list[Shape]) -> tuple[Shape, ...]:
    """Sort shapes by position, rounded to 0.1 mm, so that two lists can be compared."""
    return tuple(
        sorted(shapes, key=lambda s: (*np.round(s.lower, 4), *np.round(s.upper, 4), s.kind))
    )
