"""Check that the file names of a release are portable, inside its folder, and unique."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable

from pytest_twin.release.limits import LIMITS

# Device names of Windows, with any suffix.
_DEVICES = re.compile(r"(con|prn|aux|nul|com[0-9]|lpt[0-9])(\..*)?", re.IGNORECASE)
_FORBIDDEN = set('<>:"|?*\\')


def problem_with(name: str) -> str | None:
    """Problem of a relative POSIX path as a file name in a release, or None."""
    try:
        length = len(name.encode("utf-8"))
    except UnicodeEncodeError:
        return "is not Unicode text"
    if not name or length > LIMITS.name_bytes:
        return f"is empty or longer than {LIMITS.name_bytes} bytes"
    if any(char in _FORBIDDEN or unicodedata.category(char)[0] == "C" for char in name):
        return "contains a character that is not portable in file names"
    if unicodedata.normalize("NFC", name) != name:
        return "is not in Unicode normal form C"
    for part in name.split("/"):
        if part in ("", ".", ".."):
            return "leaves its folder or has an empty part"
        if part != part.rstrip(". ") or _DEVICES.fullmatch(part):
            return "means something else on another system"
    return None


def colliding_names(names: Iterable[str]) -> list[tuple[str, str]]:
    """Pairs of names that are the same without case, or of which one is a folder of the other."""
    seen: dict[str, str] = {}
    found: list[tuple[str, str]] = []
    listed = sorted(names)
    for name in listed:
        key = _folded(name)
        if key in seen:
            found.append((seen[key], name))
        seen[key] = name
    for name in listed:
        parts = _folded(name).split("/")
        for end in range(1, len(parts)):
            folder = "/".join(parts[:end])
            if folder in seen:
                found.append((seen[folder], name))
    # Two folders whose names differ only in case are one folder on some systems.
    folders: dict[str, str] = {}
    for name in listed:
        parts = name.split("/")
        for end in range(1, len(parts)):
            folder = "/".join(parts[:end])
            other = folders.setdefault(_folded(folder), folder)
            if other != folder:
                found.append((other, folder))
    return list(dict.fromkeys(found))


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name.casefold())
