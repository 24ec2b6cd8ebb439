"""Trace files in CSV: bitwise round trip, digests and strict reading."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pytest_twin.errors import FormatError, LimitError
from pytest_twin.formats.trace import parse_trace, read_trace, trace_text
from pytest_twin.trace import Trace

PATH = Path("trace.csv")


def trace(**columns: list[float]) -> Trace:
    length = len(next(iter(columns.values())))
    return Trace(
        ("time", "s"),
        np.arange(length) * 0.5,
        {name: ("rad", np.array(values)) for name, values in columns.items()},
    )


def write(path: Path, trace: Trace) -> str:
    """Write a trace; return its SHA-256, hex."""
    data = trace_text(trace).encode("utf-8")
    path.write_bytes(data)
    return hashlib.sha256(data).hexdigest()


def test_a_trace_is_written_as_csv_with_units_in_the_header() -> None:
    text = trace_text(trace(elbow=[0.1, -2.0, 1e-9]))
    assert text == "time [s],elbow [rad]\n0.0,0.1\n0.5,-2.0\n1.0,1e-09\n"


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_written_trace_is_read_back_bitwise_identical(data: st.DataObject) -> None:
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


def test_special_characters_in_headings_are_escaped() -> None:
    text = trace_text(trace(**{'100% of "finger[1], left"': [1.0]}))
    assert text == "time [s],100%25 of %22finger%5B1%5D%2C left%22 [rad]\n0.0,1.0\n"


def test_changed_line_endings_are_reported_as_the_cause(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    digest = write(path, trace(elbow=[1.0, 2.0]))
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    with pytest.raises(FormatError, match=r"has CR LF line endings where LF was recorded.*-text"):
        read_trace(path, digest)
    path.write_bytes(path.read_bytes().replace(b"2.0", b"2.5"))
    with pytest.raises(FormatError, match="SHA-256 differs"):
        read_trace(path, digest)


def test_a_trace_with_another_digest_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    digest = write(path, trace(elbow=[1.0, 2.0]))
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
def test_an_invalid_trace_is_refused_with_its_line(text: str, line: int, words: str) -> None:
    with pytest.raises(FormatError) as caught:
        parse_trace(text, PATH)
    assert words in str(caught.value)
    assert caught.value.line == line


def test_rows_and_columns_of_a_trace_are_limited() -> None:
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
def test_an_invalid_trace_is_not_written(broken: Trace, words: str) -> None:
    with pytest.raises(FormatError, match=words):
        trace_text(broken)
