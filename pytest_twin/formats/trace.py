"""Read and write traces as CSV: one axis, one column per series, numbers with full precision.

A heading has a name and a unit, ``position:elbow [rad]``. In the name, reserved characters (``,``
``"`` ``[`` ``]`` ``%`` and control characters) are written as ``%`` and two hex digits for each
byte of their UTF-8 form, as in URLs: ``position:finger%5B1%5D [rad]``.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from urllib.parse import quote, unquote

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import FormatError, LimitError, require_at_most
from pytest_twin.formats import limits
from pytest_twin.formats.digest import only_line_endings
from pytest_twin.formats.paths import decode_text, read_bytes
from pytest_twin.trace import Trace

_HEADING = re.compile(r"(?P<name>[^\[\],\"]+) \[(?P<unit>[^\[\],\"\s]+)\]")
_NUMBER = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
_NUMERIC_TEXT = re.compile(r"[-+.0-9eE,\n]*")


def read_trace(path: Path, sha256: str | None = None) -> Trace:
    """Read a CSV trace: a header such as ``time [s],position:elbow [rad]``, then numbers.

    Args:
        sha256: SHA-256 of the file according to the spec, hex.

    Raises:
        PathError: missing, a link, or no regular file.
        LimitError: beyond ``limits.TRACE``.
        FormatError: the digest differs, or a line has a heading without unit, a repeated heading,
            the wrong number of cells, a value that is not a finite number, or an axis value that
            does not increase.
    """
    data = read_bytes(path, limits.TRACE.file_bytes)
    if sha256 is not None:
        found = hashlib.sha256(data).hexdigest()
        if found != sha256:
            raise FormatError(
                only_line_endings(data, sha256)
                or "is not the trace that the spec names: SHA-256 differs",
                path=path,
                value=found,
                expected=sha256,
            )
    return parse_trace(decode_text(data, path), path)


def parse_trace(text: str, path: Path) -> Trace:
    """Parse CSV text; ``path`` is used in errors only. Raises as :func:`read_trace`."""
    lines = text.replace("\r\n", "\n").split("\n")
    if lines[-1] == "":
        lines.pop()
    if not lines:
        raise FormatError("empty file", path=path, line=1, expected="a header and rows of numbers")
    headings = _headings(lines[0], path)
    rows = lines[1:]
    if not rows:
        raise FormatError("no rows", path=path, line=1, expected="at least one row of numbers")
    require_at_most(len(rows), limits.TRACE.rows_count, "too many rows", path=path)
    values = _numbers(rows, headings, path)
    x = np.ascontiguousarray(values[:, 0])
    falling = np.flatnonzero(~(np.diff(x) > 0))
    if falling.size:
        row = int(falling[0]) + 1
        raise FormatError(
            "axis does not increase",
            path=path,
            line=row + 2,
            where=headings[0][0],
            value=x[row],
            unit=headings[0][1],
            expected=f"more than {x[row - 1]}",
        )
    columns = {
        name: (unit, np.ascontiguousarray(values[:, index]))
        for index, (name, unit) in enumerate(headings[1:], start=1)
    }
    return Trace(headings[0], x, columns)


def trace_text(trace: Trace) -> str:
    """Return a trace as CSV text that :func:`parse_trace` reads back to the same numbers.

    Numbers are written as the shortest text that reads back as the same double. Rounding would
    add an error to every comparison with a golden.

    Raises:
        FormatError: a heading that CSV cannot represent, a value that is not finite, an axis that
            does not increase, or series of different lengths.
        LimitError: beyond ``limits.TRACE``.
    """
    named = [(trace.axis[0], trace.axis[1], trace.x)]
    named += [(name, unit, series) for name, (unit, series) in trace.columns.items()]
    length = len(trace.x)
    for name, unit, series in named:
        if len(series) != length:
            raise FormatError(
                "series and axis differ in length",
                where=name,
                value=len(series),
                expected=str(length),
            )
        if not np.isfinite(series).all():
            raise FormatError(
                "a value that is not finite",
                where=name,
                value=float(np.asarray(series)[~np.isfinite(series)][0]),
                unit=unit,
                expected="finite numbers; the simulation may have diverged",
            )
    header = ",".join(f"{_escape(name)} [{unit}]" for name, unit, _ in named)
    table = [[float.__repr__(v) for v in np.asarray(s, np.float64).tolist()] for _, _, s in named]
    text = "\n".join([header, *map(",".join, zip(*table, strict=True))]) + "\n"
    if len(text) > limits.TRACE.file_bytes:
        raise LimitError(
            "trace is too large",
            value=len(text),
            unit="bytes",
            expected=f"at most {limits.TRACE.file_bytes}; a golden's trace is small, not a log",
        )
    # Refuse to write a trace that cannot be read back.
    parse_trace(text, Path("<trace>"))
    return text


def _headings(line: str, path: Path) -> list[tuple[str, str]]:
    cells = line.split(",")
    require_at_most(len(cells), limits.TRACE.columns_count, "too many columns", path=path, line=1)
    found: list[tuple[str, str]] = []
    for index, cell in enumerate(cells):
        match = _HEADING.fullmatch(cell)
        if match is None or len(cell) > limits.TRACE.heading_chars or not cell.isprintable():
            raise FormatError(
                f"heading {index + 1} is not a name with a unit",
                path=path,
                line=1,
                value=cell,
                expected="such as 'time [s]'",
            )
        try:
            name = unquote(match["name"], errors="strict")
        except UnicodeDecodeError:
            raise FormatError(
                f"heading {index + 1} has a % escape that is not UTF-8",
                path=path,
                line=1,
                value=cell,
                expected="'%25' for a percent sign",
            ) from None
        if any(name == other for other, _ in found):
            raise FormatError(
                "a heading occurs twice",
                path=path,
                line=1,
                value=cell,
                expected="each name once; pytest --twin-update records the trace again",
            )
        found.append((name, match["unit"]))
    return found


def _escape(name: str) -> str:
    return "".join(
        quote(char, safe="") if char in ',"[]%' or not char.isprintable() else char for char in name
    )


def _numbers(rows: list[str], headings: list[tuple[str, str]], path: Path) -> FloatArray:
    width = len(headings)
    body = "\n".join(rows)
    # Fast path for text of number characters; if it fails, the slow path locates the invalid cell.
    if _NUMERIC_TEXT.fullmatch(body) and all(row.count(",") == width - 1 for row in rows):
        try:
            cells = body.replace("\n", ",").split(",")
            values = np.array([float(cell) for cell in cells], dtype=np.float64)
        except ValueError:
            pass
        else:
            if np.isfinite(values).all():
                return values.reshape(len(rows), width)
    for line, row in enumerate(rows, start=2):
        cells = row.split(",")
        if len(cells) != width:
            raise FormatError(
                f"row has {len(cells)} value" + ("s" if len(cells) != 1 else ""),
                path=path,
                line=line,
                expected=f"{width}, one per heading",
            )
        for (name, unit), cell in zip(headings, cells, strict=True):
            value = float(cell) if len(cell) <= 400 and _NUMBER.fullmatch(cell) else np.nan
            if not np.isfinite(value):
                raise FormatError(
                    "not a finite number",
                    path=path,
                    line=line,
                    where=name,
                    value=cell,
                    unit=unit,
                    expected="a finite number",
                )
    raise FormatError(
        "cannot be read as numbers",
        path=path,
        expected="rows of numbers below the header; pytest --twin-update records the trace again",
    )
