"""Read the mesh files of an asset, each once, with a limit on their total size."""

from __future__ import annotations

from pathlib import Path

from pytest_twin.errors import TwinError, require_at_most
from pytest_twin.realization import mesh
from pytest_twin.realization.limits import LIMITS


class MeshFiles:
    """Reads meshes, and caches each mesh or its error."""

    def __init__(self) -> None:
        self.found: dict[Path, mesh.Triangles | TwinError] = {}
        self.bytes = 0
        self.faces = 0

    def read(self, path: Path) -> mesh.Triangles:
        """Return the triangles of a file, in m.

        Raises:
            FormatError: the mesh cannot be read; repeated calls raise the same error.
            LimitError: the file exceeds the limits for one mesh or for all meshes together.
        """
        if path not in self.found:
            self.found[path] = self._read(path)
        result = self.found[path]
        if isinstance(result, TwinError):
            raise result
        return result

    def _read(self, path: Path) -> mesh.Triangles | TwinError:
        try:
            self.bytes += path.stat().st_size
            self._bound("bytes", self.bytes, LIMITS.total_asset_bytes, path)
            result = mesh.read(path)
            self.faces += len(result.faces)
            self._bound("triangles", self.faces, LIMITS.total_mesh_faces, path)
        except TwinError as error:
            return error
        return result

    @staticmethod
    def _bound(what: str, count: int, most: int, path: Path) -> None:
        require_at_most(count, most, f"the meshes together have too many {what}", path=path)
