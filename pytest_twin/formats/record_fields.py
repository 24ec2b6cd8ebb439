"""Read and check fields of calibration and identification records."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NoReturn

from pytest_twin.errors import FormatError
from pytest_twin.formats import limits
from pytest_twin.formats.paths import decode_text, read_bytes

Matrix = tuple[tuple[float, ...], ...]
Z95 = 1.959964
"""Half-width of the 95 % interval of a normal distribution, in standard deviations."""


def read_record(path: Path, expected: str) -> tuple[Any, bytes]:
    """Return a record's parsed JSON and its bytes.

    Raises:
        PathError: missing, a link, or no regular file.
        LimitError: beyond ``limits.OBSERVATIONS``.
        FormatError: not JSON.
    """
    data = read_bytes(path, limits.OBSERVATIONS.file_bytes)
    try:
        return json.loads(decode_text(data, path), parse_constant=_refuse), data
    except (ValueError, RecursionError):
        raise FormatError("not JSON", path=path, expected=expected) from None


def text(value: Any) -> str:
    """Return ``value`` if it is a non-empty text.

    Raises:
        ValueError: ``value`` is anything else.
    """
    if not isinstance(value, str) or not value or len(value) > limits.OBSERVATIONS.name_chars:
        raise ValueError("a name")
    return value


def number(value: Any) -> float:
    """Return ``value`` as a finite float.

    Raises:
        ValueError: ``value`` is anything else.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{value!r} is not a finite number")
    return float(value)


def numbers(values: Any, count: int) -> tuple[float, ...]:
    """Return ``values`` as ``count`` finite floats.

    Raises:
        ValueError: ``values`` is anything else.
    """
    if not isinstance(values, list) or len(values) != count:
        raise ValueError(f"not {count} numbers")
    return tuple(number(value) for value in values)


def covariance(rows: Any, size: int) -> Matrix:
    """Return a square matrix of finite numbers, (size, size).

    Raises:
        ValueError: ``rows`` is anything else.
    """
    if not isinstance(rows, list) or len(rows) != size:
        raise ValueError(f"covariance: not {size} rows")
    try:
        return tuple(numbers(row, size) for row in rows)
    except ValueError as error:
        raise ValueError(f"covariance: {error}") from None


def optional_table(value: Any) -> dict[str, Any] | None:
    """Return ``value`` if it is a table or None.

    Raises:
        ValueError: ``value`` is anything else.
    """
    if value is not None and not isinstance(value, dict):
        raise ValueError(f"{value!r} is not a table")
    return value


def digests(content: Any) -> dict[str, str]:
    """Return input file of a record -> SHA-256, hex.

    Raises:
        ValueError, KeyError, TypeError, AttributeError: the record lacks valid digests.
    """
    return {text(name): text(one["sha256"]) for name, one in content.get("inputs", {}).items()}


def standard_deviation(ci95: Any) -> float:
    """Return the standard deviation of a normal distribution from its 95 % interval.

    Raises:
        ValueError: ``ci95`` is not an interval.
    """
    low, high = numbers(ci95, 2)
    if high < low:
        raise ValueError(f"{ci95!r} is not an interval")
    return (high - low) / (2.0 * Z95)


def _refuse(word: str) -> NoReturn:
    raise ValueError(word)
