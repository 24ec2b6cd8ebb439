"""Triangles as they are read and scaled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_mjcf_loading import binary_stl

from pytest_twin.realization import mesh
from pytest_twin.realization.limits import LIMITS
from pytest_twin.realization.shapes import hull, polyhedron


@pytest.mark.parametrize("scale", [(1, 1, 1), (2, 1, 3), (1, -1, 1), (-1, -2, -1), (-1, -1, 1)])
def test_faces_look_out_after_a_mirror(tmp_path: Path, scale: tuple[float, ...]) -> None:
    (tmp_path / "t.stl").write_bytes(binary_stl())
    read = mesh.read(tmp_path / "t.stl", LIMITS)
    scaled = read.scaled(np.array(scale, dtype=float))
    assert len(read.vertices) == 4
    signed = np.linalg.det(scaled.vertices[scaled.faces]).sum() / 6
    assert signed == pytest.approx(1e-3 / 6 * abs(np.prod(scale)), rel=1e-6)


def test_a_box_as_triangles_has_the_inertia_of_a_box() -> None:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 2) for z in (0, 3)], dtype=float)
    faces = hull(corners)
    assert faces is not None
    whole = polyhedron(corners, faces)
    assert whole is not None
    volume, centroid, moments = whole
    assert volume == pytest.approx(6)
    np.testing.assert_allclose(centroid, [0.5, 1, 1.5])
    np.testing.assert_allclose(moments, np.diag([13, 10, 5]) / 12, atol=1e-12)


def test_a_flat_mesh_has_no_volume() -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    assert hull(square) is None
    assert polyhedron(square, faces) is None
    assert mesh.Triangles(square, faces).thickness < 1e-12
