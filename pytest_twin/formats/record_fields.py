"""Read and check fields of calibration and identification records."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from pytest_twin.errors import FormatError
from pytest_twin.formats import limits
from pytest_twin.formats.paths import decode_text, read_bytes
from pytest_twin.formats.typed import FieldError

Matrix = tuple[tuple[float, ...], ...]
Size = Annotated[float, Meta(ge=0.0)]
"""An error or another number that is not negative."""
Z95 = 1.959964
"""Half-width of the 95 % interval of a normal distribution, in standard deviations."""
UNUSABLE = (KeyError, TypeError, AttributeError, ValueError)
"""What reading a field of an unexpected record raises."""


def read_record(path: Path, expected: str) -> tuple[Any, bytes]:
    """Return a record's parsed JSON and its bytes.

    Raises:
        PathError: missing, a link, or no regular file.
        LimitError: beyond ``limits.OBSERVATIONS``.
        FormatError: not JSON, not schema 1, or a number that is not finite.
    """
    import msgspec

    data = read_bytes(path, limits.OBSERVATIONS.file_bytes)
    try:
        content = msgspec.json.decode(decode_text(data, path))
    except (ValueError, RecursionError):
        raise FormatError("not JSON", path=path, expected=expected) from None
    if not isinstance(content, dict) or content.get("schema") != 1:
        raise unusable(path, "'schema'", expected)
    return content, data


def unusable(path: Path, problem: object, expected: str) -> FormatError:
    """Return the error of a field that is missing, or that is not what the command writes."""
    if isinstance(problem, FieldError):
        return FormatError(
            "a field is missing or unusable",
            path=path,
            where=problem.where,
            value=problem.value,
            expected=f"{problem.expected}, in {expected}, schema 1",
        )
    return FormatError(
        f"a field is missing or unusable: {problem}", path=path, expected=f"{expected}, schema 1"
    )


def field_of(entries: Mapping[str, Mapping[str, Any]], name: str) -> dict[str, Any]:
    """Return key -> field ``name``, of those entries that have it."""
    return {key: entry[name] for key, entry in entries.items() if name in entry}


def digests(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return input file of a record -> SHA-256, hex."""
    return {name: stated["sha256"] for name, stated in content.get("inputs", {}).items()}


def check_square(rows: Matrix, size: int) -> None:
    """Check the size of a covariance.

    Raises:
        ValueError: it is not (size, size).
    """
    if [len(row) for row in rows] != [size] * size:
        raise ValueError(f"covariance: not {size} rows of {size} numbers")


def standard_deviation(ci95: Any) -> float:
    """Return the standard deviation of a normal distribution from its 95 % interval.

    Raises:
        ValueError, TypeError: ``ci95`` is not an interval.
    """
    low, high = ci95
    if not low <= high:
        raise ValueError(f"{ci95!r} is not an interval")
    return float(high - low) / (2.0 * Z95)
