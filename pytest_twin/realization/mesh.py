"""Read triangles from STL, OBJ, PLY, COLLADA and glTF files, in m, with size limits."""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import FormatError, TwinError, require_at_most
from pytest_twin.formats import xml
from pytest_twin.formats.paths import read_bytes
from pytest_twin.realization import gltf
from pytest_twin.realization.limits import LIMITS

Vertices = NDArray[np.float64]
Faces = NDArray[np.int32]
SUFFIXES = (".stl", ".obj", ".ply", ".dae", *gltf.SUFFIXES)
_STL_HEAD, _STL_TRIANGLE = 84, 50
"""Bytes of the header and of one triangle in a binary STL file."""


@dataclass(frozen=True, slots=True)
class Triangles:
    """A triangle mesh.

    Attributes:
        vertices: (n, 3) in m.
        faces: (m, 3) indices, counter-clockwise seen from outside.
        up_axis: up axis that a COLLADA file states, ``Y_UP`` for glTF, ``Z_UP`` otherwise.
    """

    vertices: Vertices
    faces: Faces
    up_axis: str = "Z_UP"

    def scaled(self, scale: NDArray[np.float64]) -> Triangles:
        """Scale the mesh per axis, (3,); a mirrored mesh keeps outward-facing triangles."""
        faces = self.faces if np.prod(scale) > 0 else self.faces[:, ::-1]
        return Triangles(self.vertices * scale, faces, self.up_axis)

    @property
    def principal_axes(self) -> Vertices:
        """(3, 3) principal axes as right-handed columns, from the thinnest to the longest."""
        centred = self.vertices - self.vertices.mean(axis=0)
        _, axes = np.linalg.eigh(centred.T @ centred)
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        return np.asarray(axes)

    @property
    def thickness(self) -> float:
        """Extent along the thinnest principal axis, m."""
        return float(np.ptp(self.vertices @ self.principal_axes[:, 0]))


def files_of(path: Path) -> list[Path]:
    """The mesh file, and the buffer files that it refers to.

    Raises:
        TwinError: a buffer file does not exist or is outside the folder.
    """
    return [
        path,
        *(gltf.referenced_files(path) if path.suffix.lower() in gltf.SUFFIXES else ()),
    ]


def read(path: Path) -> Triangles:
    """Read a mesh file.

    The unit of a COLLADA file is applied, its up axis is not: ROS tools also show the vertices
    without a rotation.

    Raises:
        FormatError: not the format of its suffix, without triangles, or with vertices that are not
            finite.
        LimitError: too many bytes or triangles.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise FormatError("not a mesh that can be read", path=path, expected=" or ".join(SUFFIXES))
    data = read_bytes(path, LIMITS.asset_bytes)
    try:
        if suffix == ".dae":
            triangles = _collada(data, path)
        elif suffix in gltf.SUFFIXES:
            vertices, faces = gltf.triangles(data, path)
            vertices, inverse = _distinct_vertices(vertices)
            triangles = Triangles(vertices, inverse[faces].astype(np.int32), gltf.UP_AXIS)
        else:
            triangles = _trimesh(data, path)
    except (TwinError, MemoryError):
        raise
    except Exception as error:
        # The mesh parsers raise various exceptions for an invalid file.
        words = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise FormatError(f"broken {suffix[1:].upper()} mesh: {words}", path=path) from None
    if not len(triangles.faces):
        raise FormatError(
            "a mesh without triangles",
            path=path,
            expected="at least one triangle; export the surface again",
        )
    if triangles.faces.shape[1:] != (3,) or triangles.vertices.shape[1:] != (3,):
        raise FormatError(
            "a mesh that is not made of triangles",
            path=path,
            expected="three vertices a face; export the mesh as triangles",
        )
    require_at_most(len(triangles.faces), LIMITS.mesh_faces, "too many triangles", path=path)
    if not np.isfinite(triangles.vertices).all():
        odd = np.flatnonzero(~np.isfinite(triangles.vertices).all(axis=1))[0]
        raise FormatError(
            f"vertex {odd} is not finite",
            path=path,
            value=triangles.vertices[odd],
            expected="three finite coordinates; export the mesh again",
        )
    if triangles.faces.min() < 0 or triangles.faces.max() >= len(triangles.vertices):
        raise FormatError(
            "a face with a vertex that does not exist",
            path=path,
            expected=f"vertices 0 to {len(triangles.vertices) - 1}; export the mesh again",
        )
    return triangles


def _trimesh(data: bytes, path: Path) -> Triangles:
    import trimesh

    kind = path.suffix.lower()[1:]
    loaded: Any = trimesh.load(
        io.BytesIO(_parser_input(data, path)),
        file_type=kind,
        force="mesh",
        process=False,
        skip_materials=True,
    )
    every: Vertices = np.asarray(loaded.vertices, dtype=np.float64)
    vertices, inverse = _distinct_vertices(every)
    return Triangles(vertices, inverse[np.asarray(loaded.faces)].astype(np.int32))


def _parser_input(data: bytes, path: Path) -> bytes:
    """Content of a mesh file for the parser: binary data unchanged, text as UTF-8.

    Names in a text file may be in any encoding; they are not used.

    Raises:
        FormatError: an STL file that is neither text nor complete binary data.
    """
    if path.suffix.lower() == ".ply":
        return data
    if path.suffix.lower() == ".stl":
        stated = int.from_bytes(data[80:84], "little")
        if len(data) == _STL_HEAD + stated * _STL_TRIANGLE:
            return data
        if b"facet" not in data.lower():
            raise FormatError(
                "broken STL mesh: neither text nor of the length that its number of triangles "
                "requires",
                path=path,
                value=f"{stated} triangles in {len(data)} bytes",
                expected=f"{_STL_HEAD} bytes and {_STL_TRIANGLE} for each triangle",
            )
    return data.decode("utf-8", "replace").encode("utf-8")


def _distinct_vertices(vertices: Vertices) -> tuple[Vertices, NDArray[np.int64]]:
    """Distinct vertices, and the new index of each vertex; STL repeats the corners of triangles."""
    if vertices.ndim != 2:
        return vertices, np.arange(len(vertices))
    bits = np.ascontiguousarray(vertices + 0.0).view(np.uint64)
    # Sorting one hash per row is ten times faster than sorting rows.
    keys = (
        bits
        * np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)[
            : bits.shape[1]
        ]
    ).sum(axis=1, dtype=np.uint64)
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    if not np.array_equal(vertices[first][inverse], vertices, equal_nan=True):
        unique, inverse = np.unique(vertices, axis=0, return_inverse=True)
        return unique, inverse.reshape(-1)
    return vertices[first], inverse


def _collada(data: bytes, path: Path) -> Triangles:
    import collada

    # The size limits and the ban of DTDs are checked first, because pycollada would load a DTD.
    xml.parse_bytes(data, path)
    with warnings.catch_warnings():
        # pycollada uses the deprecated numpy.matrix.
        warnings.simplefilter("ignore", PendingDeprecationWarning)
        return _collada_triangles(collada.Collada(io.BytesIO(data), ignore=[collada.DaeError]))


def _collada_triangles(document: Any) -> Triangles:
    scale = document.assetInfo.unitmeter or 1.0
    vertices: list[Vertices] = []
    faces: list[NDArray[np.int64]] = []
    count = 0
    for geometry in document.scene.objects("geometry") if document.scene else ():
        for primitive in geometry.primitives():
            kind = type(primitive).__name__
            if kind in ("BoundPolylist", "BoundPolygons"):
                primitive = primitive.triangleset()
            elif kind != "BoundTriangleSet":
                continue
            if primitive.vertex_index is None or not len(primitive.vertex_index):
                continue
            vertices.append(np.asarray(primitive.vertex, dtype=np.float64) * scale)
            faces.append(np.asarray(primitive.vertex_index, dtype=np.int64) + count)
            count += len(primitive.vertex)
    if not faces:
        return Triangles(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))
    used, inverse = np.unique(np.vstack(faces), return_inverse=True)
    return Triangles(
        np.vstack(vertices)[used],
        inverse.reshape(-1, 3).astype(np.int32),
        str(document.assetInfo.upaxis),
    )
