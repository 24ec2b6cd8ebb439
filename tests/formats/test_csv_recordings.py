"""CSV recordings: any order of columns, strict numbers, errors with line and column."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pytest_twin.errors import FormatError, LimitError
from pytest_twin.formats import limits
from pytest_twin.formats.recording import Recording
from pytest_twin.formats.recordings import read_one

NAN = np.nan


def read(folder: Path, text: str | bytes, columns: dict[str, str] | None = None) -> Recording:
    path = folder / "log.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_one(path, columns=columns)


PLAIN = """\
time,b.position,a.command,a.position,a.velocity
0.0,1,0.5,3,0.1
0.01,1.5,0.25,3.5,-1e-3
0.02,2,0.125,4,nan
"""


def test_columns_may_be_in_any_order(tmp_path: Path) -> None:
    recording = read(tmp_path, PLAIN)
    state, command = recording.series["state"], recording.series["command"]
    assert state.names == ("b", "a")
    assert state.stamp.tolist() == [0, 10_000_000, 20_000_000]
    np.testing.assert_array_equal(state.position, [[1, 3], [1.5, 3.5], [2, 4]])
    np.testing.assert_array_equal(state.velocity, [[NAN, 0.1], [NAN, -1e-3], [NAN, NAN]])
    assert state.effort is None
    assert command.names == ("a",)
    for name in ("position", "velocity", "effort"):
        np.testing.assert_array_equal(getattr(command, name), [[0.5], [0.25], [0.125]])
    assert recording.notes == ()


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (["0.1", "0.2"], [100_000_000, 200_000_000]),
        (["1700000000.123456789", "1700000000.2"], [1700000000123456789, 1700000000200000000]),
        (
            ["1700000000123456789", "1700000000123956789"],
            [1700000000123456789, 1700000000123956789],
        ),
        (["-0.5", "1e-3"], [-500_000_000, 1_000_000]),
        (["0.10000000000000001", "3"], [100_000_000, 3_000_000_000]),
    ],
)
def test_times_in_seconds_or_whole_nanoseconds_are_converted_exactly(
    tmp_path: Path, cells: list[str], expected: list[int]
) -> None:
    rows = "".join(f"{cell},1\n" for cell in cells)
    found = read(tmp_path, "time,a.position\n" + rows).series["state"].stamp
    assert found.tolist() == expected


def test_whole_number_times_that_cannot_be_nanoseconds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError) as caught:
        read(tmp_path, "time,a.position\n0,1\n10,2\n20,3\n")
    assert (
        "log.csv:2: time: the unit of the times is not known (got '0, 10, 20, ...: 0.1 Hz as s, "
        "100 Hz as ms, 1e+05 Hz as us, 1e+08 Hz as ns'; expected --time-unit s, ms, us or ns, or "
        "time_unit: in twin.yaml)"
    ) in str(caught.value)


def test_a_row_without_states_or_commands_is_no_message_of_that_kind(tmp_path: Path) -> None:
    text = "time,a.position,a.command\n0.0,1,\n0.1,,7\n0.2,2,\n0.3,,\n"
    series = read(tmp_path, text).series
    assert series["state"].stamp.tolist() == [0, 200_000_000]
    assert series["command"].stamp.tolist() == [100_000_000]


@pytest.mark.parametrize(
    "columns",
    [
        {"t": "time", "q [rad]": "a.position", "u": "a.command", "absent": "b.position"},
        {"time": "t", "a.position": "q [rad]", "a.command": "u"},
    ],
)
def test_headers_are_mapped_in_either_direction(tmp_path: Path, columns: dict[str, str]) -> None:
    recording = read(tmp_path, "t,q [rad],u,note\n0.5,1,2,ok\n0.6,3,4,bad\n", columns)
    np.testing.assert_array_equal(recording.series["state"].position, [[1], [3]])
    np.testing.assert_array_equal(recording.series["command"].effort, [[2], [4]])
    assert "columns without a meaning are left out: note" in recording.notes


@pytest.mark.parametrize("change", ["\r\n", "# ", "\ufeff", '"'])
def test_line_endings_comments_byte_order_marks_and_quotes_are_accepted(
    tmp_path: Path, change: str
) -> None:
    text = PLAIN
    if change == "\r\n":
        text = text.replace("\n", "\r\n")
    elif change == '"':
        text = text.replace("time,b.position", '"time","b.position"')
    else:
        text = change + text
    found, expected = read(tmp_path, text), read(tmp_path, PLAIN)
    np.testing.assert_array_equal(found.series["state"].position, expected.series["state"].position)


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        (
            "time,a.position\n0.0,1\n0.1,x\n",
            "log.csv:3:2: a.position",
            "not a finite number (got 'x'",
        ),
        ("time,a.position\n0.0,1\n0.1,inf\n", "log.csv:3:2", "not a finite number (got 'inf'"),
        ("time,a.position\n0.0,1\n0.1,1_0\n", "log.csv:3:2", "not a finite number (got '1_0'"),
        ("time,a.position\n0.0,1\n0.1\n", "log.csv:3", "row has 1 value (expected 2"),
        ("time,a.position\n\n0.0,1,2\n", "log.csv:3", "row has 3 values (expected 2"),
        ("time,a.position\n0.0,1\n,2\n", "log.csv:3:1", "no time"),
        ("time,a.position\n0.0,1\nnan,2\n", "log.csv:3:1", "no time"),
        ("time,a.position\n0.0,1\n1e300,2\n", "log.csv:3:1: time", "no time (got '1e300'"),
        ("time,a.position\n", "log.csv:2", "no rows"),
        ("", "log.csv:1", "fewer than two columns"),
        ("time|a.position\n0|1\n", "log.csv:1", "fewer than two columns"),
        ("t,a.position\n0.0,1\n", "log.csv:1", "no column of times"),
        ("time,q1\n0.0,1\n", "log.csv:1", "no column of a joint"),
        ("time,a.position,a.position\n0.0,1,2\n", "log.csv:1:3", "a heading occurs twice"),
        ('time,"a.position\n0.0,1\n', "log.csv:1", "no CSV header"),
        (b"time,a.position\n0.0,\xff\n", "log.csv:2", "not UTF-8 text"),
    ],
)
def test_invalid_csv_is_refused_with_line_and_column(
    tmp_path: Path, text: str | bytes, place: str, words: str
) -> None:
    with pytest.raises(FormatError) as caught:
        read(tmp_path, text)
    assert place in str(caught.value)
    assert words in str(caught.value)


def test_a_column_mapping_to_an_unknown_meaning_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"columns.t: not a valid meaning of a column"):
        read(tmp_path, "t,a.position\n0.0,1\n", {"t": "clock"})


def test_decreasing_and_repeated_times_are_noted(tmp_path: Path) -> None:
    recording = read(tmp_path, "time,a.position\n0.0,1\n0.2,1\n0.1,1\n0.1,2\n")
    assert [str(note) for note in recording.damage] == [
        "/joint_states: 1 times go back, first row 2 with values",
        "/joint_states: 1 times occur twice, first row 3 with values",
    ]


def test_the_size_of_csv_files_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "CSV", replace(limits.CSV, cells_count=6, columns_count=3))
    with pytest.raises(LimitError, match="too many cells"):
        read(tmp_path, "time,a.position\n" + "0.1,1\n" * 4)
    with pytest.raises(LimitError, match="too many columns"):
        read(tmp_path, "time,a.position,b.position,c.position\n0.0,1,2,3\n")
    monkeypatch.setattr(limits, "CSV", replace(limits.CSV, file_bytes=10))
    with pytest.raises(LimitError, match="file is too large"):
        read(tmp_path, PLAIN)
