"""Convert names of joints, links and goldens to unique file names, valid on every system.

A name of ASCII letters, digits, ``_``, ``-`` and ``.`` is a valid file name everywhere and is kept.
Any other name gets a readable form and the start of its SHA-256:
``robot0:FFJ3`` becomes ``robot0_FFJ3-cc9add09``.
"""

from __future__ import annotations

import hashlib
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable

MAX_LENGTH = 80
"""Characters: leaves room for a suffix and folders within Windows' limit of 260 for a path."""

_DIGEST_LENGTHS = (8, 16, 32, 64)
"""Lengths of the digest in a file name, in hex digits. Longer ones are used if names collide."""
_VALID = re.compile(r"[A-Za-z0-9_](?:[A-Za-z0-9_.-]*[A-Za-z0-9_-])?")
_OTHER = re.compile(r"[^A-Za-z0-9_-]+")
# Windows keeps these names for devices, whatever the suffix.
_DEVICE = re.compile(r"(?:con|prn|aux|nul|conin\$|conout\$|com[0-9]|lpt[0-9])(?:\..*)?", re.I)


def portable_names(names: Iterable[str]) -> dict[str, str]:
    """Return name -> file name without suffix.

    All file names are different, also on systems for which ``FFJ3`` and ``ffj3`` are the same
    file. Such names get a part of their SHA-256 at the end. The file name of any other name does
    not depend on the other names or their order.
    """
    digits = dict.fromkeys(names, 0)
    for name in digits:
        if not _is_valid(name):
            digits[name] = _DIGEST_LENGTHS[0]
    while True:
        found = {name: _portable_name(name, length) for name, length in digits.items()}
        users = Counter(file_name.casefold() for file_name in found.values())
        shared = [name for name, file_name in found.items() if users[file_name.casefold()] > 1]
        if not shared:
            return found
        for name in shared:
            # Two full digests are never equal, so one of the lengths suffices.
            digits[name] = next((n for n in _DIGEST_LENGTHS if n > digits[name]), digits[name])


def portable_name(name: str) -> str:
    """Return the file name, without suffix, of the only name in a folder."""
    return portable_names([name])[name]


def portable_paths(paths: Iterable[str]) -> dict[str, str]:
    """Return relative POSIX path -> unique path whose parts are all valid on every system.

    Files keep a valid suffix.
    """
    given = list(dict.fromkeys(paths))
    tree: dict[str, set[str]] = {}
    for path in given:
        parts = path.split("/")
        for depth, part in enumerate(parts):
            tree.setdefault("/".join(parts[:depth]), set()).add(part)
    named = {folder: _with_suffixes(parts) for folder, parts in tree.items()}
    found = {}
    for path in given:
        parts = path.split("/")
        spelled = (named["/".join(parts[:depth])][part] for depth, part in enumerate(parts))
        found[path] = "/".join(spelled)
    return found


def _with_suffixes(parts: Iterable[str]) -> dict[str, str]:
    """Return portable names, suffix included, for the files and folders of one folder."""
    parts = sorted(parts)
    folded = Counter(part.casefold() for part in parts)
    kept = {part for part in parts if _fits(part) and folded[part.casefold()] == 1}
    found = {part: part for part in kept}
    for part, spelled in portable_names(part for part in parts if part not in kept).items():
        stem, dot, suffix = part.rpartition(".")
        ending = f".{suffix}" if stem and dot and re.fullmatch(r"[A-Za-z0-9]{1,10}", suffix) else ""
        file_name = spelled + ending
        taken = {other.casefold() for other in found.values()}
        if file_name.casefold() in taken:
            file_name = f"{_digest(part, _DIGEST_LENGTHS[-1])}{ending}"
        found[part] = file_name
    return found


def _fits(part: str) -> bool:
    """Whether an existing file or folder can keep its name; letters of any alphabet are valid."""
    return (
        unicodedata.normalize("NFC", part) == part
        and not part.endswith((".", " "))
        and not any(char in '<>:"|?*\\' or unicodedata.category(char)[0] == "C" for char in part)
        and not _DEVICE.fullmatch(part)
    )


def _is_valid(name: str) -> bool:
    return (
        len(name) <= MAX_LENGTH
        and _VALID.fullmatch(name) is not None
        and _DEVICE.fullmatch(name) is None
    )


def _portable_name(name: str, digest_length: int) -> str:
    if not digest_length:
        return name
    digest = _digest(name, digest_length)
    # Drop accents and other alphabets: systems encode them as different bytes.
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    words = _OTHER.sub("_", plain).strip("_-")[: MAX_LENGTH - digest_length - 1].rstrip("_-")
    return f"{words}-{digest}" if words else digest


def _digest(name: str, length: int) -> str:
    return hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:length]
