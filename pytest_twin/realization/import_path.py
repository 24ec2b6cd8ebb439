"""The import path of child processes: installed packages, and no folder that holds a robot's files.

A child that imports modules from the working folder or from a twin's folder runs code that nobody
has declared, such as a ``json.py`` beside a model.
"""

from __future__ import annotations

import contextlib
import functools
import os
import site
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from pathlib import Path

_TWIN_FILE = "twin.yaml"
_DISTRIBUTION_METADATA = ("*.dist-info", "*.egg-info", "*.egg-link")
"""What lies beside installed modules; ``*.egg-link`` where colcon links to the source."""


def import_path(untrusted: Iterable[Path] = ()) -> list[str]:
    """Entries of ``sys.path`` from which a child process may import modules.

    Entries at or below the working folder, a twin's folder and the ``untrusted`` folders are left
    out. Kept are folders of installed distributions and those that an editable installation adds.
    Below the working folder and the ``untrusted`` folders, entries of ``PYTHONPATH`` that contain
    distributions are kept too, such as the overlay of a colcon workspace.

    Args:
        untrusted: further folders with files of others, such as the root folder of pytest.
    """
    folders = _spellings(*untrusted)
    with contextlib.suppress(FileNotFoundError):
        folders |= _spellings(Path.cwd())
    kept: dict[str, None] = {}
    for entry in sys.path:
        path = Path(entry)
        if not path.is_absolute():
            continue
        if is_installed(path):
            # `python -m` and pytest put a folder first that an editable installation puts last:
            # its modules must not hide those of Python's library.
            kept.pop(entry, None)
            kept[entry] = None
        elif not _is_in_twin(path) and (
            not _is_inside(path, folders) or _is_overlay(entry, folders)
        ):
            kept.setdefault(entry)
    return list(kept)


@contextlib.contextmanager
def installed_modules_only(untrusted: Iterable[Path] = ()) -> Iterator[None]:
    """Import modules of this process as a child does, for the duration of the context.

    `python -m pytest` and a ``conftest.py`` put folders of the user first on the import path.
    """
    entries = list(sys.path)
    sys.path[:] = import_path(untrusted)
    try:
        yield
    finally:
        sys.path[:] = entries


def is_installed(path: Path) -> bool:
    """Whether ``path`` belongs to Python's library, or to an installation in ``site-packages``.

    The folder that an editable installation adds to the import path belongs to it, its parents do
    not.
    """
    spellings = _spellings(path)
    return _is_inside(path, _library_folders()) or not spellings.isdisjoint(_editable_folders())


@functools.cache
def _library_folders() -> frozenset[Path]:
    """Folders of Python's library and of installed distributions, with their links resolved."""
    folders = [*site.getsitepackages(), sysconfig.get_path("stdlib")]
    if site.ENABLE_USER_SITE:
        folders.append(site.getusersitepackages())
    return _spellings(*map(Path, folders))


@functools.cache
def _editable_folders() -> frozenset[Path]:
    """Folders that the ``*.pth`` files of installed distributions add to the import path."""
    return _spellings(*(path for folder in _library_folders() for path in _pth_entries(folder)))


def _pth_entries(folder: Path) -> Iterator[Path]:
    for file in folder.glob("*.pth"):
        with contextlib.suppress(OSError):
            for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
                if line.strip() and not line.startswith(("#", "import ", "import\t")):
                    yield folder / line.strip()


def _spellings(*folders: Path) -> frozenset[Path]:
    """Absolute paths of ``folders``, as written and with links resolved."""
    return frozenset(
        Path(spell(folder)) for folder in folders for spell in (os.path.abspath, os.path.realpath)
    )


def _is_inside(path: Path, folders: Iterable[Path]) -> bool:
    """Whether ``path`` is one of the ``folders`` or below one, as written or through a link."""
    spellings = _spellings(path)
    return any(one.is_relative_to(folder) for one in spellings for folder in folders)


def _is_in_twin(path: Path) -> bool:
    return any(
        (folder / _TWIN_FILE).is_file()
        for one in _spellings(path)
        for folder in (one, *one.parents)
    )


def _is_overlay(entry: str, folders: Iterable[Path]) -> bool:
    """Whether the user named the entry in ``PYTHONPATH`` and distributions are installed there."""
    named = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    path = Path(entry)
    if path not in {Path(name).absolute() for name in named if name}:
        return False
    if not _spellings(path).isdisjoint(folders):
        return False
    return any(next(path.glob(pattern), None) for pattern in _DISTRIBUTION_METADATA)
