"""Read CSV recordings: one column of times and one column for each joint quantity."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from pytest_twin.errors import FormatError, LimitError, require_at_most
from pytest_twin.formats import base_pose, limits
from pytest_twin.formats.recording import Damage, JointSeries, Recording
from pytest_twin.formats.recordings.base import ReadingOptions
from pytest_twin.formats.recordings.csv_dialect import GZIP_SUFFIX, csv_bytes, plain_table
from pytest_twin.formats.recordings.csv_headings import (
    FIELDS,
    PLOTJUGGLER_TIME,
    TIME,
    Column,
    UnitError,
    column_of,
    split_unit,
    topics_in,
)
from pytest_twin.formats.recordings.csv_numbers import Body
from pytest_twin.formats.recordings.csv_time import unit_in_heading, unit_named
from pytest_twin.formats.ros_serialization import QUANTITIES, Floats, Integers
from pytest_twin.formats.trial_metadata import metadata_beside

_LIKE_TIME = re.compile(r"t$|t[_ (]|time|stamp", re.IGNORECASE)
_MOST_RADIANS = 4.0 * math.pi
"""Joints with larger positions in rad turn more than twice, which few joints do."""
_MEANING = f"'{TIME}' or NAME.position, NAME.velocity, NAME.effort, NAME.command"


class CsvFile:
    """Reads ``.csv`` and ``.csv.gz`` files.

    The first line names the columns: ``time`` (s, or whole numbers of ns) and ``NAME.position``
    (rad or m), ``NAME.velocity``, ``NAME.effort``, ``NAME.command`` in any order, or the series of
    PlotJuggler. An empty cell or ``nan`` means that this line does not carry the value.
    """

    kind: ClassVar[str] = "CSV file"

    def reads(self, path: Path) -> bool:
        """Whether ``path`` is a file whose name ends in ``.csv`` or ``.csv.gz``."""
        return path.is_file() and path.name.lower().endswith((".csv", GZIP_SUFFIX))

    def read(self, path: Path, options: ReadingOptions) -> Sequence[Recording]:
        """Read the file as one recording."""
        return [_Table(path, csv_bytes(path), options).recording()]


class _Table:
    def __init__(self, path: Path, data: bytes, options: ReadingOptions) -> None:
        self.path, self.options = path, options
        table = plain_table(path, data)
        self.line = table.line
        self.notes = list(table.notes)
        self.header = self.headings(table.headings, table.separator)
        self.columns = self.meanings()
        self.body = table.body

    def error(self, problem: str, column: int | None = None, **details: object) -> FormatError:
        """Return an error of the line of headings; ``column`` counts from 0."""
        at = None if column is None else column + 1
        return FormatError(problem, path=self.path, line=self.line, column=at, **details)  # type: ignore[arg-type]

    def headings(self, line: str, separator: str) -> list[str]:
        try:
            cells = next(csv.reader([line], strict=True, delimiter=separator), [])
        except csv.Error as error:
            raise self.error(f"no CSV header: {error}") from None
        cells = [cell.strip() for cell in cells]
        require_at_most(
            len(cells), limits.CSV.columns_count, "too many columns", path=self.path, line=self.line
        )
        if len(cells) < 2:
            raise self.error("fewer than two columns", expected=f"a header: {_MEANING}")
        for at, cell in enumerate(cells):
            if cell in cells[:at]:
                raise self.error(
                    "a heading occurs twice", at, value=cell,
                    expected="each heading once; rename or remove one of the columns",
                )  # fmt: skip
        return cells

    def meanings(self) -> dict[int, Column]:
        """Return index of the column -> meaning; the column of times is stored separately."""
        mapped = self.mapped()
        self.left_out: list[str] = []
        self.base: dict[int, str] = {}
        self.time_at = self.time_column(mapped)
        found: dict[int, Column] = {}
        keys: set[tuple[str, str, str | None]] = set()
        for at, heading in enumerate(self.header):
            if at == self.time_at:
                continue
            if heading in base_pose.COLUMNS:
                self.base[at] = heading
                continue
            column = self.column(heading, mapped.get(heading))
            if column is None:
                self.left_out.append(heading)
                continue
            if not column.joint.isprintable() or len(column.joint) > limits.CSV.name_chars:
                raise self.error(
                    "not a usable name of a joint", at, value=column.joint,
                    expected=f"printable text of at most {limits.CSV.name_chars} characters",
                )  # fmt: skip
            if column.key in keys:
                raise self.error(
                    f"two columns are {column.joint}.{column.quantity or 'command'}", at,
                    value=heading, expected="one column for each quantity of a joint",
                )  # fmt: skip
            found[at] = column
            keys.add(column.key)
        if not found:
            topics = topics_in(self.header)
            example = topics[-1] if topics else ""
            raise self.error(
                "no column of a joint", value=", ".join(self.header),
                expected=f"{_MEANING}; "
                + (f"--topics state={topics[0]},command={example} reads series of PlotJuggler"
                   if topics else self._mapping()),
            )  # fmt: skip
        joints = {column.joint for column in found.values()}
        require_at_most(
            len(joints), limits.MCAP.joints_count, "too many joints", path=self.path, line=self.line
        )
        return self.with_units_of_joints(found)

    def column(self, heading: str, meaning: str | None) -> Column | None:
        """The meaning of a heading that is not mapped, or of a mapped meaning."""
        try:
            return column_of(meaning or heading, heading, self.options.topics)
        except UnitError as unit:
            self.notes.append(
                f"{heading}: {unit} is no unit that is converted; "
                + ("read as written" if meaning else "left out (--columns reads it as written)")
            )
        return column_of(meaning, meaning, self.options.topics) if meaning else None

    def with_units_of_joints(self, columns: Mapping[int, Column]) -> dict[int, Column]:
        """Columns whose joint has a column with a unit have it too, apart from efforts."""
        units: dict[tuple[str, str], float] = {}
        for column in columns.values():
            if column.scale is not None and column.quantity in ("position", "velocity"):
                units[column.joint, column.role] = column.scale
        found = dict(columns)
        for at, column in columns.items():
            scale = units.get((column.joint, column.role))
            if scale is None or column.scale is not None or column.quantity == "effort":
                continue
            found[at] = replace(column, scale=scale)
            if scale != 1.0:
                self.notes.append(f"{self.header[at]}: unit of the other columns of {column.joint}")
        return found

    def time_column(self, mapped: Mapping[str, str]) -> int:
        """Index of the column of times: the mapped one, ``time``, or one with a unit."""
        for wanted in (
            [h for h in self.header if mapped.get(h) == TIME],
            [h for h in self.header if h in (TIME, PLOTJUGGLER_TIME) and h not in mapped],
            [h for h in self.header if unit_in_heading(h) and h not in mapped],
        ):
            if len(wanted) == 1:
                return self.header.index(wanted[0])
            if wanted:
                raise self.error(
                    "several columns of times", value=", ".join(wanted),
                    expected=f"one; --columns '{wanted[0]}={TIME}' says which",
                )  # fmt: skip
        raise self.error(
            "no column of times", value=", ".join(self.header),
            expected=f"{_MEANING}; {self._mapping()}",
        )  # fmt: skip

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
        notes = self.notes
        if self.left_out:
            notes.append(f"columns without a meaning are left out: {', '.join(self.left_out)}")
        damage: list[Damage] = []
        series = {}
        for role, topic in self.options.topics.items():
            one = self.series(role, topic, time, values)
            if one is not None:
                series[role] = one
                damage += _time_damage(one)
        metadata, note = metadata_beside(self.path)
        base = base_pose.poses_of_columns(
            self.path, time, {heading: values[at] for at, heading in self.base.items()}
        )
        return Recording(self.path, series, metadata, tuple(damage), (*notes, *note), base=base)

    def series(
        self, role: str, topic: str, time: Integers, values: Mapping[int, Floats]
    ) -> JointSeries | None:
        chosen = {at: c for at, c in self.columns.items() if c.role == role}
        if not chosen:
            return None
        names = tuple(dict.fromkeys(column.joint for column in chosen.values()))
        carried = np.zeros(len(time), dtype=bool)
        for at in chosen:
            carried |= ~np.isnan(values[at])
        if not carried.any():
            return None
        tables: dict[str, Floats | None] = dict.fromkeys(QUANTITIES)
        for at, column in chosen.items():
            for quantity in QUANTITIES if column.quantity is None else (column.quantity,):
                table = tables[quantity]
                if table is None:
                    table = tables[quantity] = np.full((int(carried.sum()), len(names)), np.nan)
                # One column is of one unit, so an effort has none of an angle.
                table[:, names.index(column.joint)] = values[at][carried] * (column.scale or 1.0)
        self.refuse_likely_degrees(chosen, values)
        return JointSeries(
            topic=topic,
            names=names,
            stamp=time[carried],
            log_time=time[carried].copy(),
            position=tables["position"],
            velocity=tables["velocity"],
            effort=tables["effort"],
            stated=frozenset(c.joint for c in chosen.values() if c.scale is not None),
        )

    def refuse_likely_degrees(
        self, columns: Mapping[int, Column], values: Mapping[int, Floats]
    ) -> None:
        """Refuse positions of no stated unit that are beyond two turns in rad.

        Raises:
            FormatError: the unit has to be stated.
        """
        if self.options.units is not None or self.options.has_signals:
            return
        for at, column in columns.items():
            if column.quantity != "position" or column.scale is not None:
                continue
            largest = float(np.nanmax(np.abs(values[at]), initial=0.0))
            if largest > _MOST_RADIANS:
                raise self.error(
                    "positions of no stated unit are more than two turns in rad", at,
                    where=self.header[at], value=f"{largest:.6g}",
                    expected="--units deg or --units rad, units: in twin.yaml, or a heading with "
                    "the unit, such as 'elbow.position [deg]'",
                )  # fmt: skip

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
        heading, stated = split_unit(self.header[self.time_at])
        unit = self.options.time_unit or unit_in_heading(self.header[self.time_at])
        unit = unit or unit_named(stated)
        body = Body(
            self.path,
            self.body,
            self.header,
            self.time_at,
            {**self.columns, **self.base},
            self.line + 1,
            unit,
        )
        time, values, note = body.numbers()
        if note:
            self.notes.append(f"{heading}: {note}")
        return time, values


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
