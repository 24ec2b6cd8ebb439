"""Read triangles from glTF files (``.glb``, ``.gltf``); sizes are checked before unpacking."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import FormatError, LimitError, require_at_most
from pytest_twin.formats.paths import Roots, read_bytes
from pytest_twin.realization.limits import LIMITS

SUFFIXES = (".glb", ".gltf")
UP_AXIS = "Y_UP"
"""Up axis of all glTF files, by the specification."""
_MAGIC, _JSON = b"glTF", b"JSON"
_TRIANGLES = 4
"""Mode of a primitive that consists of separate triangles."""
_MAX_NODES = 10_000
"""Largest number of nodes of a file."""


def triangles(data: bytes, path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (n, 3) in m and faces (m, 3) of the whole scene, with the poses of its nodes.

    Vertices are in the frame of the file, whose y axis points up.

    Raises:
        FormatError: not glTF, or a referenced file does not exist.
        LimitError: larger than ``LIMITS``.
    """
    import trimesh

    document = _document(data, path)
    _check_counts(document, path)
    scene: Any = trimesh.load(
        io.BytesIO(data),
        file_type=path.suffix.lower()[1:],
        force="mesh",
        process=False,
        skip_materials=True,
        resolver=_buffers(document, path),
    )
    return np.asarray(scene.vertices, dtype=np.float64), np.asarray(scene.faces, dtype=np.int64)


def referenced_files(path: Path) -> list[Path]:
    """Buffer files that a ``.gltf`` file refers to; all are inside its folder.

    Raises:
        FormatError: not glTF, or a buffer file does not exist.
    """
    if path.suffix.lower() != ".gltf":
        return []
    document = _document(read_bytes(path, LIMITS.asset_bytes), path)
    return [_file(uri, path) for uri in dict.fromkeys(_uris(document))]


def _buffers(document: Mapping[str, Any], path: Path) -> dict[str, bytes]:
    """Reference -> content of each buffer file."""
    found: dict[str, bytes] = {}
    left = LIMITS.total_asset_bytes
    for uri in _uris(document):
        if uri not in found:
            found[uri] = read_bytes(_file(uri, path), min(LIMITS.asset_bytes, left))
            left -= len(found[uri])
    return found


def _file(uri: str, path: Path) -> Path:
    return Roots(path.parent).resolve(unquote(uri), at=path, where="buffers.uri")


def _document(data: bytes, path: Path) -> Mapping[str, Any]:
    text = data
    if path.suffix.lower() == ".glb":
        length = int.from_bytes(data[12:16], "little")
        if data[:4] != _MAGIC or data[16:20] != _JSON or len(data) < 20 + length:
            raise FormatError("not a whole glTF file", path=path, expected="binary glTF 2.0")
        text = data[20 : 20 + length]
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        raise FormatError(
            "not glTF: its description is not JSON",
            path=path,
            expected="glTF 2.0; export the mesh again",
        ) from None
    if not isinstance(found, dict):
        raise FormatError("not glTF", path=path, expected="a JSON object")
    return found


def _uris(document: Mapping[str, Any]) -> Iterator[str]:
    for buffer in document.get("buffers", ()):
        uri = buffer.get("uri") if isinstance(buffer, dict) else None
        if isinstance(uri, str) and not uri.startswith("data:"):
            yield uri


def _check_counts(document: Mapping[str, Any], path: Path) -> None:
    """Refuse counts above the limits, because a short file can request any amount of memory."""
    try:
        counts = [int(accessor["count"]) for accessor in document.get("accessors", ())]
        sizes = [
            sum(_faces(primitive, counts) for primitive in mesh["primitives"])
            for mesh in document.get("meshes", ())
        ]
        nodes = document.get("nodes", ())
        children = [child for node in nodes for child in node.get("children", ())]
        total = sum(sizes[node["mesh"]] for node in nodes if "mesh" in node)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        words = f"{type(error).__name__}: {error}"
        raise FormatError(f"broken glTF mesh: {words}", path=path) from None
    if len(children) != len(set(children)):
        raise FormatError(
            "broken glTF mesh: a node with two parents",
            path=path,
            expected="a tree of nodes; export the mesh again",
        )
    require_at_most(len(nodes), _MAX_NODES, "too many nodes", path=path)
    if max([total, *(count // 3 for count in counts)], default=0) > LIMITS.mesh_faces:
        raise LimitError(
            "too many triangles",
            path=path,
            value=total,
            expected=f"at most {LIMITS.mesh_faces}",
        )


def _faces(primitive: Mapping[str, Any], counts: list[int]) -> int:
    if primitive.get("mode", _TRIANGLES) != _TRIANGLES:
        return 0
    corners = primitive.get("indices", primitive["attributes"]["POSITION"])
    return int(counts[corners]) // 3
