"""Resolve references to files, and refuse those outside the folders that a twin declares."""

from __future__ import annotations

import os
import re
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from pytest_twin.errors import FormatError, LimitError, PathError
from pytest_twin.formats import limits

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")


@dataclass(frozen=True)
class Roots:
    """The folders that references may point into.

    Attributes:
        base: the twin's own folder.
        extra: further folders that the twin declares (``roots:``).
    """

    base: Path
    extra: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "base", Path(os.path.realpath(self.base)))
        extra = tuple(Path(os.path.realpath(root)) for root in self.extra)
        object.__setattr__(self, "extra", extra)

    @property
    def folders(self) -> tuple[Path, ...]:
        """Return all roots with links resolved, the base first."""
        return (self.base, *self.extra)

    def contains(self, path: Path) -> bool:
        """Whether ``path`` is inside a root after every link is resolved."""
        return self._holds(os.path.realpath(path))

    def resolve(
        self,
        reference: str,
        *,
        at: Path,
        line: int | None = None,
        where: str | None = None,
        folder: bool = False,
    ) -> Path:
        """Return the regular file (or folder) that ``reference`` names, with links resolved.

        Args:
            reference: as written; relative to the folder of ``at``.
            at: the file that contains the reference.
            line: 1-based line of the reference.
            where: field or element of the reference.
            folder: whether to look for a folder instead of a file.

        Raises:
            PathError: the reference is empty, too long, contains a NUL or control character, is a
                URL, leaves the roots at any component (by ``..``, absolute, or through a link),
                does not exist, or is not a regular file (a pipe, a socket, a device).
        """

        def refuse(problem: str, expected: str) -> PathError:
            return PathError(
                problem, path=at, line=line, where=where, value=reference, expected=expected
            )

        self._check_words(reference, refuse)
        wanted = "folder" if folder else "file"
        current = "/" if reference.startswith("/") else os.path.realpath(at.parent)
        # Component by component, so that a link out of the roots and back in is refused too.
        for part in reference.split("/"):
            if part in ("", "."):
                continue
            step = os.path.join(current, part)  # noqa: PTH118 - text: realpath follows it
            try:
                following = os.path.realpath(step, strict=True)
            except FileNotFoundError:
                if not self._leads_to_root(current, os.path.realpath(step)):
                    raise refuse(*self._outside(reference, at, folder)) from None
                raise refuse(
                    f"no such {wanted}",
                    f"a {wanted} that exists; relative paths start at {at.parent}",
                ) from None
            except (OSError, ValueError) as error:
                reason = getattr(error, "strerror", None) or str(error)
                raise refuse(
                    f"cannot be reached: {reason}", f"a {wanted} in folders that you may read"
                ) from None
            if not self._leads_to_root(current, following, by_link=part != ".."):
                raise refuse(*self._outside(reference, at, folder))
            current = following
        if not self._holds(current):
            raise refuse(*self._outside(reference, at, folder))
        found = Path(current)
        mode = found.stat().st_mode
        if folder and not stat.S_ISDIR(mode):
            raise refuse("not a folder", "a path to a folder")
        if not folder and not stat.S_ISREG(mode):
            raise refuse(f"not a regular file but {_kind(mode)}", "a path to a regular file")
        return found

    def _outside(self, reference: str, at: Path, folder: bool) -> tuple[str, str]:
        """Return the problem of a reference outside the roots, and the option that allows it."""
        inside = "a path inside " + " or ".join(str(root) for root in self.folders)
        real = os.path.realpath(at.parent / reference)
        wanted = real if folder else os.path.dirname(real)  # noqa: PTH120 - text, as realpath returns
        return (
            "path leaves the declared roots",
            f"{inside}; to allow that folder: --root {wanted} on the command line, or "
            f"'roots: [{wanted}]' in twin.yaml",
        )

    @staticmethod
    def _check_words(reference: str, refuse: object) -> None:
        assert callable(refuse)
        if not reference.strip():
            raise refuse("empty path", "a path to a file or folder")
        if len(reference) > limits.PATHS.reference_chars:
            raise refuse("path is too long", f"at most {limits.PATHS.reference_chars} characters")
        if any(ord(char) < 32 or ord(char) == 127 for char in reference):
            raise refuse("path contains a control character", "printable characters")
        try:
            encoded = os.fsencode(reference)
        except UnicodeEncodeError:
            raise refuse(
                "path contains a character that no file name can have", "a path in valid UTF-8"
            ) from None
        if any(len(part) > limits.PATHS.component_bytes for part in encoded.split(b"/")):
            raise refuse(
                "a name in the path is too long", f"at most {limits.PATHS.component_bytes} bytes"
            )
        if _SCHEME.match(reference):
            raise refuse("a URL, not a path", "a path to a file or folder of this machine")

    def _leads_to_root(self, current: str, following: str, *, by_link: bool = True) -> bool:
        """Whether a path component stays in the roots, or in a parent folder of a root.

        From inside a root, only ``..`` may lead to a parent; any other component that does is a
        link.
        """
        if self._holds(following):
            return True
        if by_link and self._holds(current):
            return False
        above = following.rstrip("/") + "/"
        return any(str(root).startswith(above) for root in self.folders)

    def _holds(self, real: str) -> bool:
        return any(
            real == str(root) or real.startswith(str(root).rstrip("/") + "/")
            for root in self.folders
        )


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading; the last component may not be a link.

    Raises:
        PathError: missing, unreadable, a link, or anything but a regular file.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        raise PathError(
            "no such file", path=path, expected="a file that exists; check the path"
        ) from None
    except (OSError, ValueError) as error:
        if path.is_symlink():
            raise PathError("is a symbolic link", path=path, expected="the file itself") from None
        reason = getattr(error, "strerror", None) or str(error)
        raise PathError(f"cannot be read: {reason}", path=path) from None
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        raise PathError(
            f"not a regular file but {_kind(mode)}", path=path, expected="a path to a regular file"
        )
    return os.fdopen(descriptor, "rb")


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """Return the content of a regular file of at most ``max_bytes``.

    Raises:
        PathError: as :func:`open_regular`.
        LimitError: the file is larger, or grows beyond the limit while it is read.
    """
    with open_regular(path) as stream:
        try:
            size = os.fstat(stream.fileno()).st_size
            data = stream.read(max_bytes + 1) if size <= max_bytes else b""
        except OSError as error:
            raise PathError(f"cannot be read: {error.strerror}", path=path) from None
    if max(size, len(data)) > max_bytes:
        raise LimitError(
            "file is too large",
            path=path,
            value=max(size, len(data)),
            unit="bytes",
            expected=f"at most {max_bytes} bytes",
        )
    return data


def decode_text(data: bytes, path: Path) -> str:
    """Decode UTF-8 text, without a byte order mark.

    Raises:
        FormatError: not UTF-8; the error has the line and column of the first invalid byte.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = data[: error.start]
        line = before.count(b"\n") + 1
        start = before.rfind(b"\n") + 1
        raise FormatError(
            "not UTF-8 text",
            path=path,
            line=line,
            column=len(before[start:].decode("utf-8", "replace")) + 1,
            value=f"byte 0x{data[error.start]:02x}",
            expected="UTF-8",
        ) from None


def _kind(mode: int) -> str:
    names = {
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a pipe",
        stat.S_IFSOCK: "a socket",
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
        stat.S_IFLNK: "a symbolic link",
    }
    return names.get(stat.S_IFMT(mode), "something else")
