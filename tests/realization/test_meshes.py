"""Reading and scaling of triangle meshes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_mjcf_loading import binary_stl

from pytest_twin.errors import FormatError
from pytest_twin.realization import mesh
from pytest_twin.realization.shapes import hull, polyhedron


@pytest.mark.parametrize("scale", [(1, 1, 1), (2, 1, 3), (1, -1, 1), (-1, -2, -1), (-1, -1, 1)])
def test_faces_keep_their_outward_orientation_when_mirrored(
    tmp_path: Path, scale: tuple[float, ...]
) -> None:
    (tmp_path / "t.stl").write_bytes(binary_stl())
    read = mesh.read(tmp_path / "t.stl")
    scaled = read.scaled(np.array(scale, dtype=float))
    assert len(read.vertices) == 4
    signed = np.linalg.det(scaled.vertices[scaled.faces]).sum() / 6
    assert signed == pytest.approx(1e-3 / 6 * abs(np.prod(scale)), rel=1e-6)


def test_volume_and_inertia_of_a_triangulated_box_match_the_closed_form() -> None:
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


def test_mesh_files_with_names_in_another_encoding_are_read(tmp_path: Path) -> None:
    facet = b"facet normal 0 0 1 outer loop vertex 0 0 0 vertex 1 0 0 vertex 0 1 0 endloop endfacet"
    (tmp_path / "t.stl").write_bytes(
        b"solid pi\xe8ce\n" + facet.replace(b" outer", b"\nouter").replace(b" vertex", b"\nvertex")
        .replace(b" end", b"\nend") + b"\nendsolid pi\xe8ce\n"
    )  # fmt: skip
    (tmp_path / "t.obj").write_bytes(b"# pi\xe8ce\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    for name in ("t.stl", "t.obj"):
        found = mesh.read(tmp_path / name)
        np.testing.assert_allclose(found.vertices.max(axis=0), [1, 1, 0])
        assert len(found.faces) == 1


@pytest.mark.parametrize("stated", [4_000_000_000, 3, 5])
def test_an_stl_whose_length_contradicts_its_triangle_count_is_refused(
    tmp_path: Path, stated: int
) -> None:
    data = bytearray(binary_stl())
    data[80:84] = stated.to_bytes(4, "little")
    (tmp_path / "t.stl").write_bytes(data)
    with pytest.raises(
        FormatError, match=f"that its number of triangles requires.*'{stated} triangles"
    ):
        mesh.read(tmp_path / "t.stl")
