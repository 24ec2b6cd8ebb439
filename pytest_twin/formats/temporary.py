"""Temporary folders and files that the next run removes if their process was killed.

Each has the prefix :data:`PREFIX` and is locked by its process (``flock``). The operating system
releases the lock when the process ends, however it ends. What is not locked has no owner any more.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from pytest_twin.errors import cannot_write

PREFIX = ".pytest-twin-"
_swept: set[tuple[int, Path]] = set()
"""Process number and folder of each sweep: a process sweeps a folder once."""


@contextlib.contextmanager
def temporary_folder(parent: Path | None = None) -> Iterator[Path]:
    """Context with an empty folder, which is deleted after the block.

    Args:
        parent: existing folder for it; the system's folder for temporary files if None.

    Raises:
        PathError: it cannot be created.
    """
    try:
        parent = Path(tempfile.gettempdir() if parent is None else parent)
        sweep(parent)
        folder, lock = _locked_folder(parent)
    except OSError as error:
        raise cannot_write(error, parent) from None
    with _closing(lock):
        try:
            yield folder
        finally:
            remove(folder)


@contextlib.contextmanager
def temporary_file(parent: Path | None = None) -> Iterator[tuple[Path, int]]:
    """Context with a new file and its descriptor; the file is deleted if it is still there.

    Args:
        parent: existing folder for it; the system's folder for temporary files if None.

    Raises:
        OSError: it cannot be created.
    """
    parent = Path(tempfile.gettempdir() if parent is None else parent)
    sweep(parent)
    while True:
        descriptor, name = tempfile.mkstemp(prefix=PREFIX, dir=parent)
        path = Path(name)
        if _lock(descriptor, path):
            break
        os.close(descriptor)
    with _closing(descriptor):
        try:
            yield path, descriptor
        finally:
            path.unlink(missing_ok=True)


def sweep(parent: Path) -> None:
    """Remove the temporary files and folders of ended processes in a folder, once per process.

    Args:
        parent: the folder; errors are ignored.
    """
    done = (os.getpid(), parent)
    if done in _swept:
        return
    _swept.add(done)
    with contextlib.suppress(OSError), os.scandir(parent) as entries:
        for entry in entries:
            if entry.name.startswith(PREFIX):
                _remove_without_owner(Path(entry.path))


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[bool]:
    """Context that locks a folder; whether no other process holds its lock.

    Raises:
        OSError: the folder cannot be opened.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    with _closing(descriptor):
        yield _try_lock(descriptor) is not False


def is_abandoned(folder: Path) -> bool:
    """Whether a folder that its process locks has no owner any more.

    False where there is no folder, and on a file system without locks.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return False
    with _closing(descriptor):
        return _try_lock(descriptor) is True


@contextlib.contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Context that one process at a time has for a folder; the others wait.

    Raises:
        OSError: the folder cannot be opened.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    with _closing(descriptor):
        # Some network file systems have no locks.
        with contextlib.suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield


def remove(path: Path) -> None:
    """Remove a file or a folder as far as the system allows."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def _closing(descriptor: int) -> Iterator[None]:
    try:
        yield
    finally:
        os.close(descriptor)


def _locked_folder(parent: Path) -> tuple[Path, int]:
    while True:
        folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent))
        try:
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        except FileNotFoundError:
            continue
        if _lock(descriptor, folder):
            return folder, descriptor
        os.close(descriptor)


def _lock(descriptor: int, path: Path) -> bool:
    """Lock a new file or folder; False if another process swept it before it was locked."""
    with contextlib.suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except FileNotFoundError:
        return False


def _try_lock(descriptor: int) -> bool | None:
    """Whether the lock was free and is held now; None on a file system without locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return False if error.errno in (errno.EWOULDBLOCK, errno.EACCES) else None
    return True


def _remove_without_owner(path: Path) -> None:
    with contextlib.suppress(OSError):
        facts = path.lstat()
        if facts.st_uid != os.getuid():
            return
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        with _closing(descriptor):
            if _try_lock(descriptor):
                remove(path)
