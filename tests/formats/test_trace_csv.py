"""Traces: what is written reads back, bit for bit, and nothing else is read."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pytest_twin.errors import FormatError, LimitError
from pytest_twin.formats.trace import parse_trace, read_trace, trace_text, write_trace
from pytest_twin.trace import Trace

PATH = Path("trace.csv")


def trace(**columns: list[float]) -> Trace:
    length = len(next(iter(columns.values())))
    return Trace(
        ("time", "s"),
        np.arange(length) * 0.5,
        {name: ("rad", np.array(values)) for name, values in columns.items()},
    )


def test_text_is_what_people_expect() -> None:
    text = trace_text(trace(elbow=[0.1, -2.0, 1e-9]))
    assert text == "time [s],elbow [rad]\n0.0,0.1\n0.5,-2.0\n1.0,1e-09\n"


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_reads_back_bit_for_bit(data: st.DataObject) -> None:
    rows = data.draw(st.integers(1, 12))
    finite = st.floats(allow_nan=False, allow_infinity=False)
    axis = data.draw(st.lists(finite, min_size=rows, max_size=rows, unique=True))
    x = np.unique(np.array(axis))
    names = data.draw(
        st.lists(
            st.text(st.characters(codec="utf-8"), max_size=8).map(lambda name: "q:" + name),
            max_size=4,
            unique=True,
        )
    )
    columns = {
        name: ("N*m", data.draw(arrays(np.float64, len(x), elements=finite))) for name in names
    }
    written = Trace(("frequency", "Hz"), x, columns)
    read = parse_trace(trace_text(written), PATH)
    assert read.axis == written.axis
    assert read.x.tobytes() == (written.x).tobytes()
    assert list(read.columns) == names
    for name in names:
        assert read.columns[name][0] == "N*m"
        assert read.columns[name][1].tobytes() == columns[name][1].tobytes()


def test_a_heading_escapes_what_csv_and_units_use() -> None:
    text = trace_text(trace(**{'100% of "finger[1], left"': [1.0]}))
    assert text == "time [s],100%25 of %22finger%5B1%5D%2C left%22 [rad]\n0.0,1.0\n"


def test_line_endings_are_named_where_nothing_else_differs(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    digest = write_trace(path, trace(elbow=[1.0, 2.0]))
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    with pytest.raises(FormatError, match=r"has CR LF line endings where LF was recorded.*-text"):
        read_trace(path, digest)
    path.write_bytes(path.read_bytes().replace(b"2.0", b"2.5"))
    with pytest.raises(FormatError, match="SHA-256 differs"):
        read_trace(path, digest)


def test_file_is_held_to_its_digest(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    digest = write_trace(path, trace(elbow=[1.0, 2.0]))
    assert digest == hashlib.sha256(path.read_bytes()).hexdigest()
    np.testing.assert_array_equal(read_trace(path, digest).columns["elbow"][1], [1.0, 2.0])
    path.write_text(path.read_text().replace("2.0", "2.5"))
    with pytest.raises(FormatError, match="SHA-256 differs"):
        read_trace(path, digest)


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("", 1, "empty file"),
        ("time [s]\n", 1, "no rows"),
        ("time [s],%ff [m]\n1,2\n", 1, "heading 2 has a % escape that is not UTF-8"),
        ("time\n1\n", 1, "heading 1 is not a name with a unit"),
        ("time [s],a []\n1,2\n", 1, "heading 2 is not a name with a unit"),
        ("time [s],a [m],a [rad]\n1,2,3\n", 1, "a heading occurs twice"),
        ("time [s],a [m]\n0,1\n1\n", 3, "row has 1 value"),
        ("time [s],a [m]\n0,1\n1,2,3\n4\n", 3, "row has 3 values"),
        ("time [s],a [m]\n0,1\n1,nan\n", 3, "not a finite number"),
        ("time [s],a [m]\n0,1e999\n", 2, "not a finite number"),
        ("time [s],a [m]\n0,1_0\n", 2, "not a finite number"),
        ("time [s],a [m]\n0, 1\n", 2, "not a finite number"),
        ("time [s],a [m]\n0,\n", 2, "not a finite number"),
        ("time [s],a [m]\n0,1\n\n", 3, "row has 1 value"),
        ("time [s],a [m]\n0,1\n2,1\n2,1\n", 4, "axis does not increase"),
        ("time [s]\n-0.0\n0.0\n", 3, "axis does not increase"),
    ],
)
def test_refuses_with_place(text: str, line: int, words: str) -> None:
    with pytest.raises(FormatError) as caught:
        parse_trace(text, PATH)
    assert words in str(caught.value)
    assert caught.value.line == line


def test_bounds_hold() -> None:
    with pytest.raises(LimitError, match="too many rows"):
        parse_trace("time [s]\n" + "1\n" * 200_001, PATH)
    with pytest.raises(LimitError, match="too many columns"):
        parse_trace(",".join(f"a{i} [m]" for i in range(600)) + "\n1\n", PATH)


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        (trace(a=[1.0, float("nan")]), "a: a value that is not finite"),
        (Trace(("time", "s"), np.array([0.0, 0.0]), {}), "axis does not increase"),
        (Trace(("time", "s"), np.array([0.0]), {"a": ("m]", np.array([1.0]))}), "heading 2"),
        (Trace(("time", "s"), np.array([0.0]), {"a": ("m", np.zeros(2))}), "differ in length"),
    ],
)
def test_what_could_not_be_read_back_is_not_written(broken: Trace, words: str) -> None:
    with pytest.raises(FormatError, match=words):
        trace_text(broken)
