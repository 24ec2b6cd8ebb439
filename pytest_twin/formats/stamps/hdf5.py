"""Read and write the stamp of an HDF5 file: the attribute ``twin`` of its root."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from pytest_twin.errors import FormatError, LimitError
from pytest_twin.formats import limits
from pytest_twin.formats.atomic import open_replacement
from pytest_twin.formats.paths import open_regular
from pytest_twin.formats.stamps.base import NAME

# An attribute in an object's header is limited to 64 KiB; longer text continues in numbered ones.
_PIECE_BYTES = 32 * 2**10
_BLOCK_ROWS = 4096
"""Number of rows of a data set that are read at once."""


@dataclass(frozen=True, slots=True)
class Hdf5Stamp:
    """An HDF5 file of demonstrations, as written by robomimic and others.

    The digest covers the names, shapes, types and values of all data sets in the file itself;
    links to other files are not followed.
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
        """Return the SHA-256 of all data sets, hex."""
        hashed, left = hashlib.sha256(), limits.STAMPS.hdf5_bytes
        with open_regular(self.path) as stream, self._opened(stream, "r") as file:
            for name, data in _datasets(file):
                if data.is_virtual or data.external:
                    raise FormatError(
                        "values stored in another file",
                        path=self.path,
                        where=name,
                        expected="data sets whose values are stored in this file",
                    )
                left -= data.nbytes
                if left < 0:
                    raise LimitError(
                        "too large after decompression",
                        path=self.path,
                        where=name,
                        expected=f"at most {limits.STAMPS.hdf5_bytes} bytes",
                    )
                head = json.dumps([name, list(data.shape or ()), str(data.dtype)])
                hashed.update(head.encode() + b"\n")
                for block in _blocks(data):
                    hashed.update(_as_bytes(block))
        return hashed.hexdigest()

    @contextmanager
    def _opened(self, stream: BinaryIO, mode: str) -> Iterator[Any]:
        h5py = _h5py(self.path)
        try:
            with h5py.File(stream, mode) as file:
                yield file
        except (OSError, RuntimeError, ValueError, KeyError) as error:
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


def _datasets(file: Any) -> list[tuple[str, Any]]:
    import h5py

    found: list[tuple[str, Any]] = []

    def visit(name: str, item: Any) -> None:
        found.append((name, item))

    file.visititems(visit)
    return sorted((n, item) for n, item in found if isinstance(item, h5py.Dataset))


def _blocks(data: Any) -> Iterator[Any]:
    """Yield the values in blocks of rows."""
    if not data.shape:
        yield data[()]
        return
    for start in range(0, data.shape[0], _BLOCK_ROWS):
        yield data[start : start + _BLOCK_ROWS]


def _as_bytes(block: Any) -> bytes:
    array = np.asarray(block)
    if array.dtype.hasobject:
        return repr(array.tolist()).encode()
    return np.ascontiguousarray(array).tobytes()
