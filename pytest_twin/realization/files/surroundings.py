"""Classify the folders above a model: packages, checkouts, shared folders."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

from pytest_twin.formats.paths import CHECKOUT
from pytest_twin.realization.files.root import Folder, Mark

# A folder that `pytest-twin intake` keeps, and the manifest next to it.
_INTAKE, _MANIFEST = "source", "manifest.json"
_SYSTEM = frozenset(
    Path(path)
    for path in (
        *("/", "/bin", "/boot", "/dev", "/etc", "/home", "/lib", "/lib64", "/media", "/mnt"),
        *("/opt", "/proc", "/root", "/run", "/sbin", "/srv", "/sys", "/tmp", "/usr", "/var"),
        *("/usr/lib", "/usr/local", "/usr/share", "/usr/local/share", "/usr/local/lib"),
        *("/var/lib", "/var/tmp", "/Users", "/Applications", "/Library", "/System", "/Volumes"),
        *("/private", "/private/tmp", "/private/var"),
    )
)
_COLLECTIONS = frozenset(
    {
        *("Desktop", "Documents", "Downloads", "Music", "Pictures", "Public", "Templates"),
        *("Videos", "Movies", "Library"),
    }
)
"""Folders in a home folder that contain unrelated files."""


def folders_above(model: Path) -> list[Folder]:
    """All folders above a model's file, nearest first; its folder contains no symbolic link."""
    home = _home()
    return [Folder(path, _mark(path), _is_shared(path, home)) for path in model.parents]


def _home() -> Path | None:
    try:
        return Path.home().resolve()
    except (OSError, RuntimeError):
        return None


def _mark(folder: Path) -> Mark | None:
    if (folder / "package.xml").is_file():
        return "package"
    if folder.name == _INTAKE and (folder.parent / _MANIFEST).is_file():
        return "intake"
    if any((folder / name).exists() for name in CHECKOUT):
        return "checkout"
    return None


def _is_shared(folder: Path, home: Path | None) -> bool:
    if folder in _SYSTEM or folder == Path(os.path.realpath(tempfile.gettempdir())):
        return True
    if home is not None:
        if home.is_relative_to(folder):
            return True
        in_home = folder.parent == home
        if in_home and (folder.name in _COLLECTIONS or folder.name.startswith(".")):
            return True
    try:
        mode = folder.stat().st_mode
    except OSError:
        return True
    # Every user may write into a folder with the sticky bit, such as /tmp.
    return bool(mode & stat.S_ISVTX and mode & stat.S_IWOTH)
