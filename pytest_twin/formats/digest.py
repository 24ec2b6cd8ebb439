"""SHA-256 of files."""

from __future__ import annotations

import hashlib
from pathlib import Path

from pytest_twin.errors import PathError, require_at_most
from pytest_twin.formats import limits
from pytest_twin.formats.paths import open_regular

_BLOCK_BYTES = 2**20
"""Number of bytes that are read at once."""

LINE_ENDINGS_ADVICE = (
    "commit a .gitattributes with '* -text' in the twin's folder (pytest-twin init writes one) "
    "and check the files out again"
)


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a regular file's bytes, hex.

    Raises:
        PathError: missing, unreadable, a link, or no regular file.
        LimitError: larger than ``limits.HASH``.
    """
    digest = hashlib.sha256()
    total = 0
    with open_regular(path, pointers=True) as stream:
        try:
            while block := stream.read(_BLOCK_BYTES):
                total += len(block)
                require_at_most(
                    total, limits.HASH.file_bytes, "file is too large", unit="bytes", path=path
                )
                digest.update(block)
        except OSError as error:
            raise PathError(f"cannot be read: {error.strerror}", path=path) from error
    return digest.hexdigest()


def bytes_sha256(data: bytes) -> str:
    """Return the SHA-256 of ``data``, hex."""
    return hashlib.sha256(data).hexdigest()


def only_line_endings(data: bytes, sha256: str) -> str | None:
    """Return advice if only CR LF line ends make the digest of ``data`` differ, else None.

    Args:
        data: the file's bytes.
        sha256: the recorded digest, hex.
    """
    if b"\r\n" not in data or bytes_sha256(data.replace(b"\r\n", b"\n")) != sha256:
        return None
    return (
        "has CR LF line endings where LF was recorded; nothing else differs. Git converts them "
        f"under core.autocrlf: {LINE_ENDINGS_ADVICE}"
    )
