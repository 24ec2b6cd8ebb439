"""Read the folders of releases: numbers, envelopes, files and digests."""

from __future__ import annotations

import hashlib
import os
import re
import stat
from pathlib import Path

from pytest_twin.errors import LimitError, PathError
from pytest_twin.formats.digest import bytes_sha256
from pytest_twin.formats.paths import open_regular, read_bytes
from pytest_twin.release.limits import LIMITS
from pytest_twin.release.verify import ENVELOPE, FolderEntry

RELEASES = "releases"
_NUMBER = re.compile(r"\d{4,9}")
_BLOCK_BYTES = 2**20
"""Number of bytes that are read at once."""
_TEXT_BYTES = 16 * 2**20  # largest size of a trace


def number_of(folder: Path) -> int | None:
    """Number of a release from the name of its folder, or None."""
    return int(folder.name) if _NUMBER.fullmatch(folder.name) else None


def numbered_releases(releases: Path) -> list[tuple[int, Path]]:
    """(number, folder) of all releases in ``releases``, the highest number first.

    Raises:
        PathError: ``releases`` is a link or cannot be read.
    """
    refuse_link(releases)
    try:
        entries = list(releases.iterdir())
    except FileNotFoundError:
        return []
    except OSError as error:
        raise PathError(f"cannot be read: {error.strerror}", path=releases) from None
    found = [(number, path) for path in entries if (number := number_of(path)) is not None]
    return sorted(found, reverse=True)


def refuse_link(folder: Path) -> None:
    """Raise an error if a folder of the twin is a link: who owns its target decides what it holds.

    Raises:
        PathError: a link.
    """
    if folder.is_symlink():
        raise PathError("a link", path=folder, expected="the folder itself, inside the twin")


def read_envelope(folder: Path) -> bytes | None:
    """Content of the envelope of a release, None if it does not exist.

    Raises:
        PathError: it is a link or cannot be read.
        LimitError: it is too large.
    """
    path = folder / ENVELOPE
    if not path.is_symlink() and not path.exists():
        return None
    return read_bytes(path, LIMITS.envelope_bytes, links=False)


def listing(folder: Path) -> dict[str, FolderEntry]:
    """All entries of a folder: relative POSIX path -> entry; links are not followed.

    Raises:
        LimitError: more entries than a release may have.
        PathError: an entry cannot be read.
    """
    found: dict[str, FolderEntry] = {}
    waiting = [folder]
    while waiting:
        here = waiting.pop()
        try:
            with os.scandir(here) as entries:
                for entry in entries:
                    path = Path(entry.path)
                    name = path.relative_to(folder).as_posix()
                    if entry.is_dir(follow_symlinks=False):
                        waiting.append(path)
                    found[name] = _entry(path)
                    if len(found) > 4 * LIMITS.files_count:
                        raise LimitError(
                            "too many files for a release",
                            path=folder,
                            expected=f"at most {LIMITS.files_count}",
                        )
        except OSError as error:
            raise PathError(f"cannot be read: {error.strerror}", path=here) from None
    return found


def digest(path: Path) -> tuple[str, int, int]:
    """SHA-256 (hex), size (bytes) and number of hard links of a regular file.

    Raises:
        PathError: it does not exist, cannot be read, is a link, or is not a regular file.
    """
    hashed, size = hashlib.sha256(), 0
    with open_regular(path, links=False) as stream:
        while block := stream.read(_BLOCK_BYTES):
            hashed.update(block)
            size += len(block)
        return hashed.hexdigest(), size, os.fstat(stream.fileno()).st_nlink


def _entry(path: Path) -> FolderEntry:
    facts = path.lstat()
    if stat.S_ISLNK(facts.st_mode):
        return FolderEntry("link")
    if stat.S_ISDIR(facts.st_mode):
        return FolderEntry("folder")
    if not stat.S_ISREG(facts.st_mode):
        return FolderEntry("other")
    if facts.st_size > LIMITS.file_bytes:
        # Not read, because no valid statement lists a file of this size.
        return FolderEntry("file", size=facts.st_size, links=facts.st_nlink)
    sha256, size, links = digest(path)
    with_lf = ""
    if size <= _TEXT_BYTES:
        data = read_bytes(path, _TEXT_BYTES, links=False)
        if b"\r\n" in data:
            with_lf = bytes_sha256(data.replace(b"\r\n", b"\n"))
    return FolderEntry("file", sha256, size, links, with_lf)
