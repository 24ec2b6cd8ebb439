"""Parse the numbers of a CSV file with NumPy, and locate the first invalid cell."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from pytest_twin.errors import FormatError
from pytest_twin.formats.recordings.csv_time import TIME_UNITS, TimeUnitError, unit_of_times
from pytest_twin.formats.ros_serialization import Floats, Integers

# Characters: a Unix time in s with 15 decimals fits; longer text is not a time.
_TIME_CHARS = 40
_INTEGER = re.compile(r"[-+]?\d{1,19}")
_DECIMAL = re.compile(r"(-?)(\d{1,9})\.(\d{0,9})")
# In s: a double below this is exact to less than 1 ns.
_EXACT_SECONDS = 1e6


@dataclass(frozen=True)
class Body:
    """The rows of a CSV file.

    Attributes:
        path: the file, for errors.
        text: all lines after the header.
        header: a heading for each column.
        time: the column of times.
        wanted: columns whose numbers are read; other columns may contain text.
        first_line: number of the first row in the file.
        unit: unit of the times, None where they have to tell.
    """

    path: Path
    text: bytes
    header: Sequence[str]
    time: int
    wanted: Collection[int]
    first_line: int = 2
    unit: str | None = None

    def numbers(self) -> tuple[Integers, dict[int, Floats], str]:
        """Return (n,) times in ns, column -> (n,) values (NaN for an empty cell), and a note.

        Raises:
            FormatError: no rows, a row of the wrong length, or a cell that is not a finite number.
                The error has the line and the column, counted in cells.
        """
        text = self.text.replace(b"\r\n", b"\n").strip(b"\n")
        if not text.strip():
            raise FormatError(
                "no rows", path=self.path, line=self.first_line, expected="rows of numbers"
            )
        written, values = self._parsed(_fill_empty_cells(text))
        if any(np.isinf(one).any() for one in values.values()):
            raise self._first_fault()
        cells = self._time_cells(text)
        whole = all(map(_INTEGER.fullmatch, cells))
        if len(written) > 1 and written.max() == written.min():
            raise FormatError(
                "the times do not advance",
                path=self.path,
                line=self.first_line,
                where=self.header[self.time],
                value=f"{cells[0]} in all {len(cells)} rows",
                expected="a time for each row, with enough digits",
            )
        unit, note = (self.unit, "") if self.unit else self._unit(written, cells, whole)
        return self._nanoseconds(written, cells, TIME_UNITS[unit], whole), values, note

    def _unit(self, written: Floats, cells: Sequence[str], whole: bool) -> tuple[str, str]:
        """The unit of the times and a note.

        Raises:
            FormatError: it has to be stated.
        """
        try:
            return unit_of_times(written, whole=whole)
        except TimeUnitError as error:
            raise FormatError(
                "the unit of the times is not known",
                path=self.path,
                line=self.first_line,
                where=self.header[self.time],
                value=", ".join(cells[:3]) + f", ...: {error}",
                expected="--time-unit s, ms, us or ns, or time_unit: in twin.yaml",
            ) from None

    def _parsed(self, text: bytes) -> tuple[Floats, dict[int, Floats]]:
        columns = sorted({self.time, *self.wanted})
        commas = len(self.header) - 1
        # NumPy checks only the used columns.
        if any(line.count(b",") != commas for line in io.BytesIO(text) if line.strip()):
            raise self._first_fault()
        try:
            table = np.loadtxt(
                io.TextIOWrapper(io.BytesIO(text), "utf-8"),
                delimiter=",",
                comments=None,
                usecols=columns,
                ndmin=2,
            )
        except (ValueError, UnicodeDecodeError):
            raise self._first_fault() from None
        found = {at: np.ascontiguousarray(table[:, n]) for n, at in enumerate(columns)}
        seconds = found[self.time]
        if not np.isfinite(seconds).all():
            self._odd_time("", int(np.flatnonzero(~np.isfinite(seconds))[0]), 1)
        return seconds, {at: found[at] for at in self.wanted}

    def _time_cells(self, text: bytes) -> list[str]:
        """(n,) cells of the column of times."""
        at = self.time
        lines = [line for line in text.split(b"\n") if line.strip()]
        return [line.split(b",", at + 1)[at].decode("utf-8", "replace").strip() for line in lines]

    def _nanoseconds(
        self, written: Floats, cells: Sequence[str], unit: int, whole: bool
    ) -> Integers:
        """(n,) times in ns, exact to 1 ns.

        Args:
            written: (n,) times as written.
            unit: ns in one unit.
            whole: whether all are whole numbers.

        Raises:
            FormatError: a time is out of range.
        """
        largest = float(np.abs(written).max())
        if whole and largest * unit < 2.0**63:
            return np.array([int(cell) for cell in cells], dtype=np.int64) * unit
        if largest * unit < _EXACT_SECONDS * TIME_UNITS["s"]:
            return np.rint(written * unit).astype(np.int64)
        found = np.empty(len(cells), dtype=np.int64)
        for row, cell in enumerate(cells):
            plain = _DECIMAL.fullmatch(cell) if unit == TIME_UNITS["s"] else None
            if plain is None:
                found[row] = self._odd_time(cell, row, unit)
            else:
                ns = int(plain[2] + plain[3].ljust(9, "0"))
                found[row] = -ns if plain[1] else ns
        return found

    def _odd_time(self, cell: str, row: int, unit: int) -> int:
        """Parse a time with an exponent, with more than nine decimals, or of invalid form."""
        try:
            seconds = Decimal(cell) if len(cell) <= _TIME_CHARS else Decimal("nan")
            if seconds.is_finite() and seconds.adjusted() < -30:
                return 0
            if seconds.is_finite() and abs(seconds) * unit < 2**33 * TIME_UNITS["s"]:
                return int((seconds * unit).to_integral_value())
        except InvalidOperation:
            pass
        line = [n for n, text in enumerate(io.BytesIO(self.text), self.first_line) if text.strip()][
            row
        ]
        raise FormatError(
            "no time",
            path=self.path,
            line=line,
            column=self.time + 1,
            where=self.header[self.time],
            value=cell,
            expected="s, or a whole number of ns",
        )

    def _first_fault(self) -> FormatError:
        for number, raw in enumerate(io.BytesIO(self.text), start=self.first_line):
            if not raw.strip():
                continue
            try:
                cells = raw.decode("utf-8").rstrip("\r\n").split(",")
            except UnicodeDecodeError:
                return FormatError("not UTF-8 text", path=self.path, line=number, expected="UTF-8")
            if len(cells) != len(self.header):
                return FormatError(
                    f"row has {len(cells)} value" + ("s" if len(cells) != 1 else ""),
                    path=self.path,
                    line=number,
                    expected=f"{len(self.header)}, one for each heading",
                )
            for at, cell in enumerate(cells):
                if at == self.time and not cell.strip():
                    cell = "nothing"
                if at in (self.time, *self.wanted) and not _is_number(cell):
                    return FormatError(
                        "not a finite number",
                        path=self.path,
                        line=number,
                        column=at + 1,
                        where=self.header[at],
                        value=cell,
                        expected="a time as a number"
                        if at == self.time
                        else "a number, or nothing where the row does not carry it",
                    )
        return FormatError(
            "cannot be read as numbers",
            path=self.path,
            expected="rows of numbers below the header, one number for each heading",
        )


def _is_number(cell: str) -> bool:
    if not cell:
        return True
    try:
        return not math.isinf(float(cell)) and "_" not in cell
    except ValueError:
        return False


def _fill_empty_cells(text: bytes) -> bytes:
    """Replace empty cells by ``nan``."""
    if b",," in text:
        for _ in range(2):
            text = text.replace(b",,", b",nan,")
    text = text.replace(b",\n", b",nan\n").replace(b"\n,", b"\nnan,")
    if text.startswith(b","):
        text = b"nan" + text
    return text + b"nan" if text.endswith(b",") else text
