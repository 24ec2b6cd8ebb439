"""Read the metadata of a trial from a YAML file beside a recording that cannot carry them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pytest_twin.errors import FormatError
from pytest_twin.formats import limits, yaml

SUFFIX = ".yaml"
_MOST = 100
"""Largest number of entries."""


def file_beside(recording: Path) -> Path | None:
    """Return the file with the metadata of a CSV recording, ``NAME.csv.yaml``; None without one."""
    if not recording.name.lower().endswith((".csv", ".csv.gz")):
        return None
    path = recording.with_name(recording.name + SUFFIX)
    return path if path.exists() or path.is_symlink() else None


def metadata_beside(recording: Path) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the metadata in the file beside a recording, and a note that they were read.

    Raises:
        FormatError: the file is not a mapping of names to short values.
    """
    path = file_beside(recording)
    if path is None:
        return {}, ()
    content = yaml.load(path).data
    expected = "a mapping such as role: fit, payload: kg05, temperature: 20 C, controller: soft"
    if not isinstance(content, dict):
        raise FormatError("not the metadata of a trial", path=path, expected=expected)
    return checked_metadata(content, path), (f"metadata of the trial from {path.name}",)


def checked_metadata(found: Mapping[str, object], path: Path) -> dict[str, str]:
    """Return metadata as text.

    Args:
        found: name -> value.
        path: file that errors name.

    Raises:
        FormatError: too many entries, or one that is not short text, a number or a truth value.
    """
    if len(found) > _MOST:
        raise FormatError(
            "too many entries", path=path, value=len(found), expected=f"at most {_MOST}"
        )
    metadata = {}
    for key, value in found.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        is_text = isinstance(value, (str, int, float)) and len(text) <= limits.CSV.name_chars
        if not is_text or not text.isprintable() or not str(key).isprintable():
            raise FormatError(
                "not a value of a trial's metadata", path=path, where=str(key)[:80],
                value=text[:80],
                expected=f"text of at most {limits.CSV.name_chars} characters, or a number",
            )  # fmt: skip
        metadata[str(key)] = text
    return metadata
