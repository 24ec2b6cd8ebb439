"""Simulate a kill, or a disk that becomes full, at one of the file operations of a block.

An audit hook raises at the chosen operation and at every later one, so that no clean-up code
changes a file after the kill, as after SIGKILL.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Callable, Iterator

_CHANGES = {"os.rename", "os.mkdir", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.chmod"}
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
_remaining: int | None = None
"""Number of file operations that still succeed; None where no kill is simulated."""
_is_full = False
"""Whether the disk becomes full instead."""
_installed = False


class Killed(BaseException):
    """The simulated end of the process."""


def _hook(event: str, arguments: tuple[object, ...]) -> None:
    global _remaining
    if _remaining is None:
        return
    is_write = event == "open" and isinstance(arguments[2], int) and arguments[2] & _WRITES
    # A full disk still renames and removes.
    if is_write or (event == "os.mkdir" if _is_full else event in _CHANGES):
        _remaining -= 1
        if _remaining < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) if _is_full else Killed


@contextlib.contextmanager
def killed_after(operations: int) -> Iterator[None]:
    """Let the first file operations of the block succeed, and none after them.

    Raises:
        Killed: the block had more operations.
    """
    with _limited(operations, is_full=False):
        yield


@contextlib.contextmanager
def full_after(operations: int) -> Iterator[None]:
    """Let the first writes of the block succeed; those after them find no space on the disk."""
    with _limited(operations, is_full=True):
        yield


@contextlib.contextmanager
def _limited(operations: int, *, is_full: bool) -> Iterator[None]:
    global _remaining, _is_full, _installed
    if not _installed:
        sys.addaudithook(_hook)
        _installed = True
    _remaining, _is_full = operations, is_full
    try:
        yield
    finally:
        _remaining = None


def at_every_operation(
    run: Callable[[], object], check: Callable[[int], None], limit: int = 500
) -> int:
    """Run a block again and again, killed after 0, 1, 2, ... file operations, until it ends.

    Args:
        run: the block; it prepares its files itself when ``check`` has restored them.
        check: called after each kill with the number of operations that succeeded.
        limit: largest number of operations.

    Returns:
        Number of kills.
    """
    for operations in range(limit):
        try:
            with killed_after(operations):
                run()
        except Killed:
            check(operations)
        else:
            return operations
    raise AssertionError(f"more than {limit} file operations")
