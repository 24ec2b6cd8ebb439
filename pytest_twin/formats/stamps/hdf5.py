"""Read and write the stamp of an HDF5 file: the attribute ``twin`` of its root."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from pytest_twin.errors import FormatError
from pytest_twin.formats.atomic import open_replacement
from pytest_twin.formats.paths import open_regular
from pytest_twin.formats.stamps.base import NAME

# An attribute in an object's header is limited to 64 KiB; longer text continues in numbered ones.
_PIECE_BYTES = 32 * 2**10


@dataclass(frozen=True, slots=True)
class Hdf5Stamp:
    """An HDF5 file of demonstrations, as written by robomimic and others.

    The digest covers all that can be read: links, attributes, types, shapes and values. Content in
    other files is refused.
    """

    path: Path

    def read(self) -> str | None:
        """Return the attribute's text, or None."""
        with open_regular(self.path) as stream, self._opened(stream, "r") as file:
            if NAME not in file.attrs:
                return None
            pieces = [file.attrs[NAME], *(file.attrs[name] for name in _rest(file))]
        if not all(isinstance(piece, str) for piece in pieces):
            raise FormatError(
                "the stamp is not text", path=self.path, where=f"attribute {NAME}",
                expected="the text that pytest-twin stamp wrote",
            )  # fmt: skip
        return "".join(pieces)

    def write(self, text: str) -> None:
        """Write the attribute to a copy, which then replaces the file."""
        pieces = _pieces(text)
        with open_regular(self.path) as source, open_replacement(self.path) as target:
            shutil.copyfileobj(source, target)
            target.flush()
            with self._opened(target, "r+") as file:
                for name in [NAME, *_rest(file)]:
                    if name in file.attrs:
                        del file.attrs[name]
                for at, piece in enumerate(pieces):
                    file.attrs[NAME if at == 0 else f"{NAME}_{at}"] = piece

    def digest(self) -> str:
        """Return the SHA-256 of all that can be read, hex."""
        with open_regular(self.path) as stream, self._opened(stream, "r") as file:
            # The module needs h5py, whose absence ``_opened`` reports.
            from pytest_twin.formats.stamps.hdf5_content import content_digest

            size = stream.seek(0, 2)
            return content_digest(file, self.path, size, frozenset({NAME, *_rest(file)}))

    @contextmanager
    def _opened(self, stream: BinaryIO, mode: str) -> Iterator[Any]:
        h5py = _h5py(self.path)
        try:
            with h5py.File(stream, mode) as file:
                yield file
        except (OSError, RuntimeError, ValueError, KeyError, TypeError, MemoryError) as error:
            raise FormatError(
                f"cannot be read as HDF5: {' '.join(str(error).split())[:100]}", path=self.path,
                expected="an undamaged HDF5 file",
            ) from None  # fmt: skip


def _h5py(path: Path) -> Any:
    try:
        import h5py
    except ImportError:
        raise FormatError(
            "HDF5 files are read by h5py, which is not installed",
            path=path,
            expected="pip install 'pytest-twin[hdf5]'",
        ) from None
    return h5py


def _pieces(text: str) -> list[str]:
    """Split the text into parts of at most 32 KiB; the stamp's JSON is ASCII."""
    return [text[at : at + _PIECE_BYTES] for at in range(0, len(text), _PIECE_BYTES)] or [""]


def _rest(file: Any) -> list[str]:
    """Return the names of the numbered attributes that continue the text, in order."""
    names: list[str] = []
    while f"{NAME}_{len(names) + 1}" in file.attrs:
        names.append(f"{NAME}_{len(names) + 1}")
    return names
