"""Unpack a supplier's archive or folder safely, without writing outside the target folder.

This module runs in the child process, whose limits on memory and time apply.
"""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import os
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Any, BinaryIO

from pytest_twin.errors import (
    DISK_ERRORS,
    FormatError,
    LimitError,
    PathError,
    TwinError,
    cannot_write,
)
from pytest_twin.formats.paths import CHECKOUT, open_regular

_BLOCK = 2**20
"""Number of bytes that are copied at once."""
_READ_ONLY = 0o444
"""File mode of the copies, because a source must not change."""
_OPENERS: dict[bytes, Any] = {b"\x1f\x8b": gzip.open, b"BZ": bz2.open, b"\xfd7": lzma.open}
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)


@dataclass(frozen=True, slots=True)
class IntakeLimits:
    """Limits for a supplier's archive or folder.

    Attributes:
        files: largest number of files.
        file_bytes, total_bytes: largest unpacked size of one file and of all files.
        archive_bytes: largest size of the archive.
        depth: largest number of nested folders.
        name_bytes: largest length of one path component.
    """

    files: int = 20_000
    file_bytes: int = 2 * 2**30
    total_bytes: int = 4 * 2**30
    archive_bytes: int = 4 * 2**30
    depth: int = 32
    name_bytes: int = 255


LIMITS = IntakeLimits()


def unpack(origin: str, folder: str, limits: IntakeLimits = LIMITS) -> list[str]:
    """Copy every file of an archive or a folder into an empty folder, read-only.

    Files of version control itself, such as ``.git``, are left out: they differ between clones of
    one revision, and git would not add the folder around them.

    Args:
        origin: a zip, a tar (plain, gzip, bzip2, xz), or a folder.

    Returns:
        The files, relative to ``folder``, sorted.

    Raises:
        PathError: a name leaves the folder, or an entry is neither a file nor a folder.
        FormatError: a damaged or encrypted archive, or two files with one name.
        LimitError: a limit is exceeded.
    """
    path, target = Path(origin), _Target(Path(origin), Path(folder), limits)
    try:
        if path.is_dir():
            _folder(path, target)
        else:
            _archive(path, target)
    except TwinError:
        raise
    except (tarfile.TarError, zipfile.BadZipFile, EOFError, zlib.error, lzma.LZMAError) as error:
        raise FormatError(f"a damaged archive: {_words(error)}", path=path) from None
    except OSError as error:
        if error.errno in DISK_ERRORS:
            raise cannot_write(error, folder) from None
        raise FormatError(f"an archive that cannot be read: {_words(error)}", path=path) from None
    except (NotImplementedError, RuntimeError, ValueError) as error:
        raise FormatError(f"an archive that cannot be read: {_words(error)}", path=path) from None
    if not target.names:
        raise FormatError("it contains no file", path=path, expected="a robot's files")
    return sorted(target.names.values())


def _words(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


class _Target:
    """Writes files to the target folder and checks the limits."""

    def __init__(self, origin: Path, folder: Path, limits: IntakeLimits) -> None:
        self.origin = origin
        self.folder = folder
        self.limits = limits
        self.names: dict[str, str] = {}
        self.bytes = 0

    def refuse(self, problem: str, name: str, expected: str) -> PathError:
        return PathError(problem, path=self.origin, value=name, expected=expected)

    def limit(self, problem: str, name: str, expected: str) -> LimitError:
        return LimitError(problem, path=self.origin, value=name, expected=expected)

    def put(self, name: str, stream: IO[bytes]) -> None:
        """Write one file, unless it belongs to version control."""
        if not CHECKOUT.isdisjoint(PurePosixPath(name).parts):
            return
        place = self._place(name)
        target = self.folder / place
        self._folders(target.parent)
        written = 0
        with target.open("xb") as out:
            while block := stream.read(_BLOCK):
                written += len(block)
                self.bytes += len(block)
                if written > self.limits.file_bytes:
                    bound = f"at most {self.limits.file_bytes} bytes"
                    raise self.limit("a file is too large", name, bound)
                if self.bytes > self.limits.total_bytes:
                    bound = f"at most {self.limits.total_bytes} bytes"
                    raise self.limit("too large after unpacking", name, bound)
                out.write(block)
        target.chmod(_READ_ONLY)

    def _place(self, name: str) -> PurePosixPath:
        place = PurePosixPath(name)
        if not name or name.startswith("/") or ".." in place.parts:
            raise self.refuse("a path outside the archive", name, "a relative path")
        if "\\" in name or ":" in place.parts[0]:
            raise self.refuse("a name of another system", name, "folders separated by '/'")
        if not name.isprintable():
            raise self.refuse("a name with a control character", name, "printable characters")
        parts = [part for part in place.parts if part != "."]
        if not parts:
            raise self.refuse("a file without a name", name, "the name of a file")
        if len(parts) > self.limits.depth:
            raise self.limit("folders too deep", name, f"at most {self.limits.depth}")
        try:
            too_long = any(len(os.fsencode(part)) > self.limits.name_bytes for part in parts)
        except UnicodeEncodeError:
            raise self.refuse(
                "a file name that cannot be encoded", name, "a name in valid UTF-8"
            ) from None
        if too_long:
            raise self.limit("a name is too long", name, f"at most {self.limits.name_bytes} bytes")
        place = PurePosixPath(*parts)
        # On some file systems, names that differ only in case name the same file.
        key = str(place).casefold()
        if key in self.names:
            raise FormatError(
                "two files of one name", path=self.origin, value=name, expected=self.names[key]
            )
        if len(self.names) >= self.limits.files:
            raise self.limit("too many files", name, f"at most {self.limits.files}")
        self.names[key] = str(place)
        return place

    def _folders(self, folder: Path) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise self.refuse(
                "a file where a folder should be", folder.name, "either a file or a folder"
            ) from None


def _folder(path: Path, target: _Target) -> None:
    waiting = [PurePosixPath()]
    while waiting:
        below = waiting.pop()
        for entry in sorted(os.scandir(path / below), key=lambda entry: entry.name):
            if entry.name in CHECKOUT:
                continue
            place = below / entry.name
            if len(place.parts) > target.limits.depth:
                raise target.limit("folders too deep", str(place), f"{target.limits.depth}")
            if entry.is_symlink():
                raise target.refuse("a link", str(place), "the file itself")
            if entry.is_dir(follow_symlinks=False):
                waiting.append(place)
                continue
            with open_regular(path / place, links=False, pointers=True) as stream:
                target.put(str(place), stream)


def _archive(path: Path, target: _Target) -> None:
    with open_regular(path, pointers=True) as stream:
        size = os.fstat(stream.fileno()).st_size
        if size > target.limits.archive_bytes:
            bound = f"at most {target.limits.archive_bytes} bytes"
            raise target.limit("the archive is too large", path.name, bound)
        head = stream.read(262 + 8)
        stream.seek(0)
        if head.startswith(b"PK"):
            _zip(stream, target)
        elif head[:2] in _OPENERS or head[257:262] == b"ustar":
            with _decompress(stream, head) as plain:
                _tar(plain, target)
        else:
            raise FormatError("not an archive", path=path, expected="a zip, a tar, or a folder")


def _zip(stream: BinaryIO, target: _Target) -> None:
    with zipfile.ZipFile(stream) as archive:
        for entry in archive.infolist():
            if entry.is_dir():
                continue
            kind = stat.S_IFMT(entry.external_attr >> 16)
            if kind not in (0, stat.S_IFREG):
                raise target.refuse("a link or a device", entry.filename, "files and folders")
            if entry.flag_bits & 0x1:
                raise FormatError(
                    "an encrypted file",
                    path=target.origin,
                    value=entry.filename,
                    expected="an archive without a password: unpack it and pack it again",
                )
            if entry.compress_type not in _METHODS:
                raise FormatError(
                    f"compression method {entry.compress_type} is not supported",
                    path=target.origin,
                    value=entry.filename,
                    expected="stored, deflate, bzip2 or LZMA: unpack it and pack it again",
                )
            if entry.file_size > target.limits.file_bytes:
                bound = f"at most {target.limits.file_bytes} bytes"
                raise target.limit("a file is too large", entry.filename, bound)
            with archive.open(entry) as content:
                target.put(entry.filename, content)


def _tar(stream: IO[bytes], target: _Target) -> None:
    with tarfile.open(fileobj=stream, mode="r|") as archive:
        for count, entry in enumerate(archive):
            if count > 4 * target.limits.files:
                raise target.limit("too many entries", entry.name, f"{4 * target.limits.files}")
            if entry.isdir():
                continue
            if not entry.isreg():
                raise target.refuse("a link or a device", entry.name, "files and folders")
            content = archive.extractfile(entry)
            if content is not None:
                target.put(entry.name, content)


@contextmanager
def _decompress(stream: BinaryIO, head: bytes) -> Iterator[IO[bytes]]:
    opener = _OPENERS.get(head[:2])
    if opener is None:
        yield stream
        return
    with opener(stream, "rb") as plain:
        assert isinstance(plain, io.BufferedIOBase)
        yield plain  # type: ignore[misc]
