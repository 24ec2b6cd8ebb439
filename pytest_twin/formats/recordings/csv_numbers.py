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
from pytest_twin.formats.ros_serialization import Floats, Integers

# Characters: a Unix time in s with 15 decimals fits; longer text is not a time.
_TIME_CHARS = 40
_INTEGER = re.compile(r"[-+]?\d{1,19}")
_DECIMAL = re.compile(r"(-?)(\d{1,9})\.(\d{0,9})")
# In s: a double below this is exact to less than 1 ns.
_EXACT_SECONDS = 1e6
# Whole numbers closer than this are not ns: no robot logs at more than 1 MHz.
_SHORTEST_STEP_NS = 1000


@dataclass(frozen=True)
class Body:
    """The rows of a CSV file.

    Attributes:
        path: the file, for errors.
        text: all lines after the header.
        header: a heading for each column.
        time: the column of times.
        wanted: columns whose numbers are read; other columns may contain text.
    """

    path: Path
    text: bytes
    header: Sequence[str]
    time: int
    wanted: Collection[int]

    def numbers(self) -> tuple[Integers, dict[int, Floats]]:
        """Return (n,) times in ns, and column -> (n,) values, NaN for an empty cell.

        Raises:
            FormatError: no rows, a row of the wrong length, or a cell that is not a finite number.
                The error has the line and the column, counted in cells.
        """
        text = self.text.replace(b"\r\n", b"\n").strip(b"\n")
        if not text.strip():
            raise FormatError("no rows", path=self.path, line=2, expected="rows of numbers")
        seconds, values = self._parsed(_fill_empty_cells(text))
        if any(np.isinf(one).any() for one in values.values()):
            raise self._first_fault()
        exact = (np.abs(seconds) < _EXACT_SECONDS).all()
        if exact and (seconds != np.floor(seconds)).any():
            return np.rint(seconds * 1e9).astype(np.int64), values
        return self._times(text, seconds), values

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
            self._odd_time("", int(np.flatnonzero(~np.isfinite(seconds))[0]))
        return seconds, {at: found[at] for at in self.wanted}

    def _times(self, text: bytes, seconds: Floats) -> Integers:
        at = self.time
        lines = [line for line in text.split(b"\n") if line.strip()]
        cells = [line.split(b",", at + 1)[at].decode("utf-8", "replace").strip() for line in lines]
        if all(map(_INTEGER.fullmatch, cells)) and (np.abs(seconds) < 2.0**63).all():
            whole = np.array([int(cell) for cell in cells], dtype=np.int64)
            step = int(np.median(np.abs(np.diff(whole)))) if len(whole) > 1 else 0
            if 0 < step < _SHORTEST_STEP_NS:
                raise FormatError(
                    "times are integers, which are read as ns",
                    path=self.path,
                    line=2,
                    where=self.header[at],
                    value=f"a step of {step} ns",
                    expected="ns, or s with a decimal point (0.0, 0.01, ...)",
                )
            return whole
        found = np.empty(len(cells), dtype=np.int64)
        for row, cell in enumerate(cells):
            plain = _DECIMAL.fullmatch(cell)
            if plain is None:
                found[row] = self._odd_time(cell, row)
            else:
                ns = int(plain[2] + plain[3].ljust(9, "0"))
                found[row] = -ns if plain[1] else ns
        return found

    def _odd_time(self, cell: str, row: int) -> int:
        """Parse a time with an exponent, with more than nine decimals, or of invalid form."""
        try:
            seconds = Decimal(cell) if len(cell) <= _TIME_CHARS else Decimal("nan")
            if seconds.is_finite() and seconds.adjusted() < -30:
                return 0
            if seconds.is_finite() and abs(seconds) < 2**33:
                return int((seconds * 1_000_000_000).to_integral_value())
        except InvalidOperation:
            pass
        line = [n for n, text in enumerate(io.BytesIO(self.text), 2) if text.strip()][row]
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
        for number, raw in enumerate(io.BytesIO(self.text), start=2):
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
                        expected="a time"
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
