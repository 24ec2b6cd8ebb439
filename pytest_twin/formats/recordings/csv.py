"""Read CSV recordings: one column of times and one column for each joint quantity."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from pytest_twin.errors import FormatError, LimitError
from pytest_twin.formats import limits
from pytest_twin.formats.paths import decode_text, read_bytes
from pytest_twin.formats.recording import Damage, JointSeries, Recording
from pytest_twin.formats.recordings.base import ReadingOptions
from pytest_twin.formats.recordings.csv_numbers import Body
from pytest_twin.formats.ros_serialization import QUANTITIES, Floats, Integers

TIME = "time"
FIELDS = (*QUANTITIES, "command")
_LIKE_TIME = re.compile(r"t$|t[_ (]|time|stamp", re.IGNORECASE)
_MEANING = f"'{TIME}' or NAME.position, NAME.velocity, NAME.effort, NAME.command"


@dataclass(frozen=True)
class _Column:
    joint: str
    field: str


class CsvFile:
    """Reads ``.csv`` files.

    The first line names the columns: ``time`` (s, or whole numbers of ns) and ``NAME.position``
    (rad or m), ``NAME.velocity``, ``NAME.effort``, ``NAME.command`` in any order. An empty cell or
    ``nan`` means that this line does not carry the value.
    """

    kind: ClassVar[str] = "CSV file"

    def reads(self, path: Path) -> bool:
        """Whether ``path`` is a file with suffix ``.csv``."""
        return path.is_file() and path.suffix.lower() == ".csv"

    def read(self, path: Path, options: ReadingOptions) -> Sequence[Recording]:
        """Read the file as one recording."""
        data = read_bytes(path, limits.CSV.file_bytes)
        return [_Table(path, data, options).recording()]


class _Table:
    def __init__(self, path: Path, data: bytes, options: ReadingOptions) -> None:
        self.path, self.options = path, options
        data = data.removeprefix(b"\xef\xbb\xbf")
        head, _, body = data.partition(b"\n")
        if len(head) > limits.CSV.header_bytes:
            raise LimitError(
                "the first line is too long",
                path=path,
                line=1,
                expected=f"at most {limits.CSV.header_bytes} bytes",
            )
        self.header = self.headings(decode_text(head, path))
        self.columns = self.meanings()
        self.body = body

    def headings(self, line: str) -> list[str]:
        line = line.strip().removeprefix("#").strip()
        try:
            cells = next(csv.reader([line], strict=True), [])
        except csv.Error as error:
            raise FormatError(f"no CSV header: {error}", path=self.path, line=1) from None
        cells = [cell.strip() for cell in cells]
        if len(cells) > limits.CSV.columns_count:
            raise LimitError(
                "too many columns",
                path=self.path,
                line=1,
                value=len(cells),
                expected=f"at most {limits.CSV.columns_count}",
            )
        if len(cells) < 2:
            problem = "fewer than two columns"
            if any(mark in line for mark in ";\t"):
                problem = "columns are not separated by commas"
            raise FormatError(problem, path=self.path, line=1, expected=f"a header: {_MEANING}")
        for at, cell in enumerate(cells):
            if cell in cells[:at]:
                raise FormatError(
                    "a heading occurs twice",
                    path=self.path,
                    line=1,
                    column=at + 1,
                    value=cell,
                    expected="each heading once; rename or remove one of the columns",
                )
        return cells

    def meanings(self) -> dict[int, _Column]:
        """Return index of the column -> meaning; the column of times is stored separately."""
        mapped = self.mapped()
        self.time_at = -1
        self.left_out: list[str] = []
        found: dict[int, _Column] = {}
        for at, heading in enumerate(self.header):
            meaning = mapped.get(heading, heading)
            if meaning == TIME:
                self.time_at = at
                continue
            joint, dot, name = meaning.rpartition(".")
            if not dot or name not in FIELDS or not joint:
                self.left_out.append(heading)
                continue
            if not joint.isprintable() or len(joint) > limits.CSV.name_chars:
                raise FormatError(
                    "not a usable name of a joint",
                    path=self.path,
                    line=1,
                    column=at + 1,
                    value=joint,
                    expected=f"printable text of at most {limits.CSV.name_chars} characters",
                )
            column = _Column(joint, name)
            if column in found.values():
                raise FormatError(
                    f"two columns are {meaning}",
                    path=self.path,
                    line=1,
                    column=at + 1,
                    value=heading,
                    expected="one column for each quantity of a joint",
                )
            found[at] = column
        if self.time_at < 0:
            raise FormatError(
                "no column of times",
                path=self.path,
                line=1,
                value=", ".join(self.header),
                expected=f"{_MEANING}; {self._mapping()}",
            )
        if not found:
            raise FormatError(
                "no column of a joint",
                path=self.path,
                line=1,
                value=", ".join(self.header),
                expected=f"{_MEANING}; {self._mapping()}",
            )
        joints = {column.joint for column in found.values()}
        if len(joints) > limits.MCAP.joints_count:
            raise LimitError(
                "too many joints",
                path=self.path,
                line=1,
                value=len(joints),
                expected=f"at most {limits.MCAP.joints_count}",
            )
        return found

    def _mapping(self) -> str:
        """Return advice for an error: the option that maps headings of this file."""
        times = [heading for heading in self.header if _LIKE_TIME.match(heading)]
        time = times[0] if times else self.header[0]
        other = next((heading for heading in self.header if heading != time), "HEADING")
        return (
            f"map other headings by --columns {time}={TIME},{other}=NAME.position,... or by "
            "columns: in twin.yaml"
        )

    def mapped(self) -> dict[str, str]:
        """Return heading -> meaning, from a mapping in either direction."""
        found: dict[str, str] = {}
        for left, right in self.options.columns.items():
            if left in self.header:
                heading, meaning = left, right
            elif right in self.header:
                heading, meaning = right, left
            else:
                # One mapping serves many files, so a column that this file lacks is not an error.
                continue
            if meaning != TIME and meaning.rpartition(".")[2] not in FIELDS:
                raise FormatError(
                    "not a valid meaning of a column",
                    path=self.path,
                    where=f"columns.{heading}",
                    value=meaning,
                    expected=_MEANING,
                )
            found[heading] = meaning
        return found

    def recording(self) -> Recording:
        time, values = self.numbers()
        notes = []
        if self.left_out:
            notes.append(f"columns without a meaning are left out: {', '.join(self.left_out)}")
        damage: list[Damage] = []
        series = {}
        for role, topic in self.options.topics.items():
            one = self.series(role, topic, time, values)
            if one is not None:
                series[role] = one
                damage += _time_damage(one)
        if "command" in series:
            notes.append(
                "NAME.command does not say whether it is a position, velocity or effort: the "
                "model's actuators decide, or command_mode"
            )
        return Recording(self.path, series, {}, tuple(damage), tuple(notes))

    def series(
        self, role: str, topic: str, time: Integers, values: Mapping[int, Floats]
    ) -> JointSeries | None:
        fields = ("command",) if role == "command" else QUANTITIES
        chosen = {at: c for at, c in self.columns.items() if c.field in fields}
        if not chosen:
            return None
        names = tuple(dict.fromkeys(column.joint for column in chosen.values()))
        carried = np.zeros(len(time), dtype=bool)
        for at in chosen:
            carried |= ~np.isnan(values[at])
        if not carried.any():
            return None
        tables: dict[str, Floats | None] = dict.fromkeys(fields)
        for at, column in chosen.items():
            table = tables[column.field]
            if table is None:
                table = tables[column.field] = np.full((int(carried.sum()), len(names)), np.nan)
            table[:, names.index(column.joint)] = values[at][carried]
        if role == "command":
            tables = dict.fromkeys(QUANTITIES, tables["command"])
        return JointSeries(
            topic=topic,
            names=names,
            stamp=time[carried],
            log_time=time[carried].copy(),
            position=tables["position"],
            velocity=tables["velocity"],
            effort=tables["effort"],
        )

    def numbers(self) -> tuple[Integers, dict[int, Floats]]:
        """Return (n,) times in ns, and column -> (n,) values."""
        rows = self.body.count(b"\n") + 1
        if rows > limits.MCAP.messages_count or rows * len(self.header) > limits.CSV.cells_count:
            raise LimitError(
                "too many cells",
                path=self.path,
                value=rows * len(self.header),
                expected=f"at most {limits.CSV.cells_count}",
            )
        return Body(self.path, self.body, self.header, self.time_at, self.columns).numbers()


def _time_damage(series: JointSeries) -> list[Damage]:
    step = np.diff(series.stamp)
    found = []
    for what, bad in (("go back", step < 0), ("occur twice", step == 0)):
        if bad.any():
            at = int(np.flatnonzero(bad)[0]) + 1
            found.append(
                Damage(series.topic, f"{int(bad.sum())} times {what}, first row {at} with values")
            )
    return found


__all__ = ["FIELDS", "TIME", "CsvFile"]
