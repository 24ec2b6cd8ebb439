"""Resolve references to files, and refuse those outside the folders that a twin declares."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from pytest_twin.errors import FormatError, PathError, PointerError, require_at_most
from pytest_twin.formats import limits
from pytest_twin.formats.declared_inputs import declared_inputs
from pytest_twin.formats.links import allowed_end

_POINTER, _POINTER_BYTES = b"version https://git-lfs.github.com/spec/", 1024
"""Beginning of a Git LFS pointer, and the size below which each is
(https://github.com/git-lfs/git-lfs/blob/main/docs/spec.md)."""
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")

CHECKOUT = frozenset({".git", ".hg", ".svn", ".jj"})
"""Names under which version control keeps its own files, beside the files that it tracks."""
_PACKAGE = "package.xml"
"""File that marks the folder of a ROS package."""


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
        """Return all roots with links resolved, the base first, those of the command line last."""
        named = declared_inputs()
        listed = (self.base, *self.extra, *named.roots, *named.packages.values())
        return tuple(dict.fromkeys(listed))

    def contains(self, path: Path) -> bool:
        """Whether ``path`` is inside a root after every link is resolved."""
        return _holds(self.folders, os.path.realpath(path))

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
                URL, leaves the roots at any component (by ``..``, absolute, or through a link that
                does not end in the same store), does not exist, or is not a regular file (a pipe, a
                socket, a device).
        """

        def refuse(problem: str, expected: str) -> PathError:
            return PathError(
                problem, path=at, line=line, where=where, value=reference, expected=expected
            )

        self._check_words(reference, refuse)
        wanted = "folder" if folder else "file"
        current = "/" if reference.startswith("/") else os.path.realpath(at.parent)
        folders = self.folders
        # Component by component, so that a link out of the roots and back in is refused too.
        for part in reference.split("/"):
            if part in ("", "."):
                continue
            step = os.path.join(current, part)  # noqa: PTH118 - text: realpath follows it
            try:
                following = os.path.realpath(step, strict=True)
            except FileNotFoundError:
                if not _leads_to_root(folders, current, os.path.realpath(step)):
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
            if not _leads_to_root(folders, current, following, by_link=part != ".."):
                end = allowed_end(Path(step), Path(following)) if part != ".." else None
                if end is None:
                    raise refuse(*self._outside(reference, at, folder))
                folders = (*folders, end)
            current = following
        if not _holds(folders, current):
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
        real = Path(os.path.realpath(at.parent / reference))
        wanted = real if folder else real.parent
        # The folder of a mesh rarely suffices: textures and other meshes are beside it.
        package = (one for one in real.parents if (one / _PACKAGE).is_file())
        wanted = next(package, wanted)
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


def _leads_to_root(
    folders: Sequence[Path], current: str, following: str, *, by_link: bool = True
) -> bool:
    """Whether a path component stays in the roots, or in a parent folder of a root.

    From inside a root, only ``..`` may lead to a parent; any other component that does is a link.
    """
    if _holds(folders, following):
        return True
    if by_link and _holds(folders, current):
        return False
    above = following.rstrip("/") + "/"
    return any(str(root).startswith(above) for root in folders)


def _holds(folders: Sequence[Path], real: str) -> bool:
    return any(
        real == str(root) or real.startswith(str(root).rstrip("/") + "/") for root in folders
    )


def follow(path: Path) -> Path:
    """Return the file or folder at a path, behind links that may be followed.

    Raises:
        PathError: a link that neither ends in the same store nor where the user allows it.
    """
    link = Path(os.path.realpath(path.parent)) / path.name
    if not link.is_symlink():
        return path
    target = Path(os.path.realpath(link))
    if target.is_relative_to(link.parent) or allowed_end(link, target) is not None:
        return target
    raise PathError(
        "is a link to another folder",
        path=path,
        value=target,
        expected=f"the file itself; to allow the folder behind the link: --root {target.parent}",
    )


def open_regular(path: Path, *, links: bool = True, pointers: bool = False) -> BinaryIO:
    """Open a regular file for reading.

    Args:
        links: whether it may be a link that :func:`follow` allows.
        pointers: whether it may be a pointer of Git LFS or a link written as text, whose content
            is elsewhere.

    Raises:
        PathError: missing, unreadable, another link, or anything but a regular file.
        PointerError: a pointer of Git LFS, or a link written as text.
    """
    file = follow(path) if links else path
    try:
        descriptor = os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        raise PathError(
            "no such file", path=path, expected="a file that exists; check the path"
        ) from None
    except (OSError, ValueError) as error:
        if path.is_symlink():
            raise PathError("is a symbolic link", path=path, expected="the file itself") from None
        reason = getattr(error, "strerror", None) or str(error)
        raise PathError(f"cannot be read: {reason}", path=path) from None
    facts = os.fstat(descriptor)
    if not stat.S_ISREG(facts.st_mode):
        os.close(descriptor)
        raise PathError(
            f"not a regular file but {_kind(facts.st_mode)}",
            path=path,
            expected="a path to a regular file",
        )
    if not pointers and facts.st_size < _POINTER_BYTES:
        content = os.pread(descriptor, _POINTER_BYTES, 0)
        if content.startswith(_POINTER):
            os.close(descriptor)
            raise PointerError(
                "is a Git LFS pointer, not the file itself",
                path=path,
                expected="the file's content: run git lfs pull in the checkout it comes from",
            )
        target = _link_target(file, content)
        if target is not None:
            os.close(descriptor)
            raise PointerError(
                "is a link that was checked out or unpacked as text, not the file itself",
                path=path,
                value=target,
                expected="the file's content: check out again where links can be made "
                "(git config core.symlinks true), or copy the named file here",
            )
    return os.fdopen(descriptor, "rb")


def _link_target(file: Path, content: bytes) -> str | None:
    """Target of a link that git or an archive wrote as a text file; None for another file.

    Git writes the target alone, without a line feed, where links cannot be made (gitattributes,
    core.symlinks). No format that is read here allows a file that holds only a path.
    """
    if not content or b"\n" in content or b"\0" in content:
        return None
    target = os.fsdecode(content)
    if target.startswith(("./", "../")):
        return target
    if target == file.name or target in (".", "..") or target != target.strip():
        return None
    return target if os.path.lexists(file.parent / target) else None


def read_bytes(path: Path, max_bytes: int, *, links: bool = True) -> bytes:
    """Return the content of a regular file of at most ``max_bytes``.

    Args:
        max_bytes: largest size.
        links: as for :func:`open_regular`.

    Raises:
        PathError: as :func:`open_regular`.
        LimitError: the file is larger, or grows beyond the limit while it is read.
    """
    with open_regular(path, links=links) as stream:
        try:
            size = os.fstat(stream.fileno()).st_size
            data = stream.read(max_bytes + 1) if size <= max_bytes else b""
        except OSError as error:
            raise PathError(f"cannot be read: {error.strerror}", path=path) from None
    require_at_most(max(size, len(data)), max_bytes, "file is too large", unit="bytes", path=path)
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
