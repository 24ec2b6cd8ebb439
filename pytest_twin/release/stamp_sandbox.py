"""Read stamps of data sets and policies in a child process, if a C or C++ library parses them.

An untrusted file may exploit a fault of such a library. The child has limits of time and memory,
and its answers are text. Where the kernel has Landlock, the child can open only files in the data's
folder, and write none of them where stamps are only read.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pytest_twin.formats.stamps import Carrier, carriers_of
from pytest_twin.realization.confinement import why_not_confined
from pytest_twin.realization.sandbox import Sandbox

_BY_LIBRARIES = frozenset({".h5", ".hdf5", ".onnx"})
_SECONDS = 1800.0
"""Time limit of one file, s: enough for the digest of 100 GB at 60 MB/s."""


@dataclass(frozen=True)
class ParsedInChild:
    """A file with a stamp that only the child process opens.

    Attributes:
        sandbox: the child process, shared by all files of a data set.
    """

    path: Path
    sandbox: Sandbox

    def read(self) -> str | None:
        """Text of the stamp, None without a stamp."""
        found = self._call("read_text")
        return None if found is None else str(found)

    def write(self, text: str) -> None:
        """Write the text of a stamp; it replaces an earlier one."""
        self._call("write_text", text=text)

    def digest(self) -> str:
        """SHA-256 of the content without the stamp, hex."""
        return str(self._call("digest"))

    def _call(self, function: str, **more: str) -> object:
        arguments = {"path": str(self.path.absolute()), **more}
        return self.sandbox.call(f"{__name__}:{function}", arguments)


def carriers_in_child(dataset: Path, *, writable: bool) -> list[Carrier]:
    """Files of a data set or policy that can contain a stamp, as found by ``carriers_of``.

    The child process ends when the last of them is deleted.

    Args:
        dataset: file or folder.
        writable: whether stamps will be written; the child may then write the data's folder.

    Raises:
        TwinError: no file that can contain a stamp.
    """
    place = dataset.resolve()
    folder = place if place.is_dir() else place.parent
    sandbox = Sandbox(
        seconds=_SECONDS,
        confined_to=[folder] if why_not_confined() is None else None,
        write=[folder] if writable else [],
    )
    return [
        ParsedInChild(one.path, sandbox) if one.path.suffix.lower() in _BY_LIBRARIES else one
        for one in carriers_of(dataset)
    ]


def read_text(path: str) -> str | None:
    """Read the text of a stamp; runs in the child process."""
    return _single_carrier(path).read()


def write_text(path: str, text: str) -> None:
    """Write the text of a stamp; runs in the child process."""
    _single_carrier(path).write(text)


def digest(path: str) -> str:
    """Digest of the stamped content, hex; runs in the child process."""
    return _single_carrier(path).digest()


def _single_carrier(path: str) -> Carrier:
    (found,) = carriers_of(Path(path))
    return found
