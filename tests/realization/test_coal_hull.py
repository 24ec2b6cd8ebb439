"""Convex hulls for coal: exact, or slightly smaller for vertices with too many neighbours."""

from __future__ import annotations

import coal
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from pytest_twin.realization.coal_hull import convex_hull, outward_faces


def cone(count: int) -> np.ndarray:
    """A cone of 0.1 m radius and 0.2 m height with ``count`` vertices around its base."""
    turn = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    ring = np.stack([0.1 * np.cos(turn), 0.1 * np.sin(turn), np.zeros(count)], axis=1)
    return np.vstack([ring, [[0.0, 0.0, 0.2]]])


@pytest.mark.parametrize("count", [60, 300, 2000])
def test_distances_to_a_hull_are_right_for_any_number_of_neighbours_of_a_vertex(count: int) -> None:
    points = cone(count)
    made = convex_hull(points, outward_faces(ConvexHull(points), points))
    ball = coal.Sphere(0.05)
    for away in ([0.4, 0.1, 0.0], [0.0, 0.0, 0.5], [-0.2, 0.3, -0.2]):
        at = coal.Transform3s(np.eye(3), np.array(away))
        arguments = (ball, at, coal.DistanceRequest(), coal.DistanceResult())
        found = coal.distance(made, coal.Transform3s(), *arguments)
        exact = coal.distance(
            coal.Cone(0.1, 0.2),
            coal.Transform3s(np.eye(3), np.array([0, 0, 0.1])),
            *arguments[:2],
            coal.DistanceRequest(),
            coal.DistanceResult(),
        )
        assert found == pytest.approx(exact, abs=3e-4)
