"""Digest of what a file states: comments and layout of YAML and CSV do not count."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

from pytest_twin.errors import TwinError
from pytest_twin.formats import limits, yaml
from pytest_twin.formats.digest import bytes_sha256, file_sha256
from pytest_twin.formats.paths import decode_text, read_bytes


def content_digest(path: Path) -> str:
    """Return the SHA-256 of a file's content, hex: of its values for YAML and CSV, else its bytes.

    Raises:
        PathError: missing, unreadable, a link, or no regular file.
        LimitError: larger than its limit.
    """
    suffix = path.suffix.lower()
    try:
        if suffix in (".yaml", ".yml"):
            return bytes_sha256(json.dumps(yaml.load(path).data, sort_keys=True).encode())
        if suffix == ".csv":
            text = decode_text(read_bytes(path, limits.OBSERVATIONS.file_bytes), path)
            rows = [[_value(cell) for cell in row] for row in csv.reader(io.StringIO(text)) if row]
            return bytes_sha256(json.dumps(rows).encode())
    except (TwinError, csv.Error, ValueError):
        # A file that cannot be read as its suffix says has no values to compare.
        pass
    return file_sha256(path)


def _value(cell: str) -> int | float | str:
    try:
        # Stamps in ns are longer than a float is exact.
        return int(cell)
    except ValueError:
        pass
    try:
        value = float(cell)
    except ValueError:
        return cell.strip()
    return int(value) if value.is_integer() else value
