"""Read ``observations.csv``, which has a row for each observation of a calibration."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import FormatError, LimitError, require_at_most
from pytest_twin.formats import limits
from pytest_twin.formats.paths import decode_text, read_bytes


@dataclass(frozen=True)
class ObservationTable:
    """Cells of an observation file.

    Attributes:
        header: heading of each column.
        lines: 1-based line of each row.
        cells: heading -> the text of each row, without surrounding space.
    """

    path: Path
    header: tuple[str, ...]
    lines: tuple[int, ...]
    cells: Mapping[str, tuple[str, ...]]

    def __len__(self) -> int:
        return len(self.lines)

    def numbers(self, heading: str) -> FloatArray:
        """Return the (rows,) values of a column, NaN for an empty cell.

        Raises:
            FormatError: a cell is not a finite number; the error has its line and column.
        """
        found = np.full(len(self), np.nan)
        for row, cell in enumerate(self.cells[heading]):
            if not cell or cell.lower() == "nan":
                continue
            try:
                value = float(cell)
            except ValueError:
                value = math.inf
            if not math.isfinite(value) or "_" in cell:
                raise self.error(
                    row,
                    heading,
                    "not a finite number",
                    value=cell,
                    expected="a number, or nothing where the row does not have it",
                )
            found[row] = value
        return found

    def error(self, row: int, heading: str, problem: str, **details: Any) -> FormatError:
        """Build the error for one cell."""
        return FormatError(
            problem,
            path=self.path,
            line=self.lines[row],
            column=self.header.index(heading) + 1,
            where=heading,
            **details,
        )


def read_observations(path: Path) -> ObservationTable:
    """Read a CSV file of observations.

    Raises:
        PathError: missing, a link, or no regular file.
        LimitError: beyond ``limits.OBSERVATIONS``.
        FormatError: no header, a repeated heading, a row of the wrong length, or no rows.
    """
    bounds = limits.OBSERVATIONS
    text = decode_text(read_bytes(path, bounds.file_bytes).removeprefix(b"\xef\xbb\xbf"), path)
    reader = csv.reader(io.StringIO(text), strict=True)
    header: tuple[str, ...] = ()
    rows: list[Sequence[str]] = []
    lines: list[int] = []
    try:
        for cells in reader:
            if not any(cell.strip() for cell in cells):
                continue
            if not header:
                header = _header(cells, path, reader.line_num)
                continue
            if len(cells) != len(header):
                raise FormatError(
                    f"row has {len(cells)} cells",
                    path=path,
                    line=reader.line_num,
                    expected=f"{len(header)}, one for each heading",
                )
            if len(rows) >= bounds.rows_count:
                raise LimitError(
                    "too many rows",
                    path=path,
                    line=reader.line_num,
                    expected=f"at most {bounds.rows_count} observations",
                )
            rows.append([cell.strip() for cell in cells])
            lines.append(reader.line_num)
    except csv.Error as error:
        raise FormatError(f"not CSV: {error}", path=path, line=reader.line_num) from None
    if not rows:
        raise FormatError(
            "no observations", path=path, expected="a header, then one row for each observation"
        )
    columns = {name: tuple(row[at] for row in rows) for at, name in enumerate(header)}
    return ObservationTable(path, header, tuple(lines), columns)


def _header(cells: Sequence[str], path: Path, line: int) -> tuple[str, ...]:
    bounds = limits.OBSERVATIONS
    header = tuple(cell.strip().lstrip("#").strip() for cell in cells)
    require_at_most(len(header), bounds.columns_count, "too many columns", path=path, line=line)
    for at, name in enumerate(header):
        problem = None
        if name in header[:at]:
            problem = "a heading occurs twice"
        elif len(name) > bounds.name_chars or not name.isprintable():
            problem = "not a usable heading"
        if problem is not None:
            raise FormatError(
                problem,
                path=path,
                line=line,
                column=at + 1,
                value=name,
                expected=f"each heading once, at most {bounds.name_chars} printable characters",
            )
    return header
