"""Data sets and policies whose format a library in C or C++ reads: parsed in a child process.

A file from elsewhere may exploit a fault of such a library. The child is bounded in time and
memory, and what it answers is text. Where the kernel has Landlock, it can open no file outside the
data's folder, and write none there where stamps are only read.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pytest_twin.formats.stamps import Carrier, carriers_of
from pytest_twin.realization.confinement import obstacle
from pytest_twin.realization.sandbox import Sandbox

_BY_LIBRARIES = frozenset({".h5", ".hdf5", ".onnx"})
_SECONDS = 1800.0
"""Bound on one file, s: a digest of 100 GB at 60 MB/s."""


@dataclass(frozen=True)
class ParsedApart:
    """A carrier of a stamp whose file the child process alone opens.

    Attributes:
        path: the file.
        sandbox: shared by all files of a data set.
    """

    path: Path
    sandbox: Sandbox

    def read(self) -> str | None:
        """The stamp's text, None where there is none."""
        found = self._call("read_text")
        return None if found is None else str(found)

    def write(self, text: str) -> None:
        """Write the text in place of an earlier stamp."""
        self._call("write_text", text=text)

    def digest(self) -> str:
        """SHA-256 of the stamped content without the stamp itself, hex."""
        return str(self._call("digest"))

    def _call(self, function: str, **more: str) -> object:
        arguments = {"path": str(self.path.absolute()), **more}
        return self.sandbox.call(f"{__name__}:{function}", arguments)


def carriers_apart(dataset: Path, *, writable: bool) -> list[Carrier]:
    """The carriers of a data set or policy, as ``carriers_of`` finds them.

    The child ends with the last of them.

    Args:
        dataset: the file or folder.
        writable: whether stamps are written into it: the child may then write the data's folder.

    Raises:
        TwinError: nothing that holds a stamp.
    """
    place = dataset.resolve()
    folder = place if place.is_dir() else place.parent
    sandbox = Sandbox(
        seconds=_SECONDS,
        confined_to=[folder] if obstacle() is None else None,
        write=[folder] if writable else [],
    )
    return [
        ParsedApart(one.path, sandbox) if one.path.suffix.lower() in _BY_LIBRARIES else one
        for one in carriers_of(dataset)
    ]


def read_text(path: str) -> str | None:
    """In the child: the text of a stamp."""
    return _only(path).read()


def write_text(path: str, text: str) -> None:
    """In the child: write the text of a stamp."""
    _only(path).write(text)


def digest(path: str) -> str:
    """In the child: the digest of what is stamped."""
    return _only(path).digest()


def _only(path: str) -> Carrier:
    (found,) = carriers_of(Path(path))
    return found
