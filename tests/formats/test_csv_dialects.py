"""CSV as programs write it is read with the numbers of the plain form, or the unit is asked for."""

from __future__ import annotations

import gzip
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_twin.errors import FormatError, LimitError
from pytest_twin.formats import limits
from pytest_twin.formats.recording import Recording
from pytest_twin.formats.recordings import read_one
from pytest_twin.formats.recordings.csv_time import TIME_UNITS, TimeUnitError, unit_of_times

ROWS = [(0.01 * k, math.sin(0.1 * k), 0.5 - 0.01 * k) for k in range(40)]
HEADINGS = ("time", "elbow.position", "elbow.command")


def csv(
    separator: str = ",",
    headings: tuple[str, ...] = HEADINGS,
    cell: Callable[[float], str] = "{:.6f}".format,
    time: Callable[[float], str] = "{:.6f}".format,
    scale: float = 1.0,
) -> str:
    lines = [separator.join(headings)]
    for row in ROWS:
        lines.append(separator.join([time(row[0]), *(cell(scale * value) for value in row[1:])]))
    return "\n".join(lines) + "\n"


def read(folder: Path, text: str | bytes, name: str = "log.csv", **options: object) -> Recording:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_one(path, **options)  # type: ignore[arg-type]


def comma(value: float) -> str:
    return f"{value:.6f}".replace(".", ",")


def quoted(form: Callable[[float], str]) -> Callable[[float], str]:
    return lambda value: f'"{form(value)}"'


def assert_as_recorded(found: Recording) -> None:
    state, command = found.series["state"], found.series["command"]
    expected = np.array(ROWS)
    np.testing.assert_array_equal(state.stamp - state.stamp[0], np.rint(expected[:, 0] * 1e9))
    assert state.names == command.names == ("elbow",)
    np.testing.assert_allclose(state.position, expected[:, 1:2], atol=1e-6)
    np.testing.assert_allclose(command.position, expected[:, 2:], atol=1e-6)


DEGREES = 180.0 / math.pi
PLOTJUGGLER = ("__time", "/joint_states/elbow/position", "/joint_commands/elbow/position")
FORMS = {
    "semicolons and decimal commas": (csv(";", cell=comma, time=comma), "decimal comma"),
    "semicolons": (csv(";"), "separated by semicolons"),
    "tabs": (csv("\t"), "separated by tabs"),
    "spaces": (csv(" "), "separated by spaces"),
    "several spaces": (csv("  ").replace("\n", " \r\n"), "separated by spaces"),
    "spaces and decimal commas": (csv(" ", cell=comma, time=comma), "decimal comma"),
    "quotes": (csv(cell=quoted("{:.6f}".format), time=quoted("{:.6f}".format)), None),
    "quoted decimal commas": (csv(cell=quoted(comma), time=quoted(comma)), "decimal comma"),
    "separator named in the first line": ("sep=;\n" + csv(";"), "separated by semicolons"),
    "comments": ("# a logger\n#\n" + csv(), None),
    "microseconds since 1970": (
        csv(time=lambda t: str(1_700_000_000_000_000 + round(1e6 * t))),
        "read as us (dates and 100 Hz)",
    ),
    "milliseconds since 1970": (
        csv(time=lambda t: f"{1_700_000_000_000 + 1e3 * t:.1f}"),
        "read as ms (their dates say so)",
    ),
    "unit of times in the heading": (
        csv(headings=("time_ms", *HEADINGS[1:]), time=lambda t: str(round(1e3 * t))),
        None,
    ),
    "units of joints in the headings": (
        csv(headings=("t [s]", "elbow.position [deg]", "elbow.command (deg)"), scale=DEGREES),
        None,
    ),
    "milliradians": (
        csv(headings=("t [s]", "elbow.position [mrad]", "elbow.command [mrad]"), scale=1e3),
        None,
    ),
    "series of PlotJuggler": (csv(headings=PLOTJUGGLER), None),
    "series of PlotJuggler, name in brackets": (
        csv(
            headings=("__time", "/joint_states/position[elbow]", "/joint_commands/position[elbow]")
        ),
        None,
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_each_form_has_the_numbers_of_the_plain_one(tmp_path: Path, form: str) -> None:
    text, note = FORMS[form]
    found = read(tmp_path, text)
    assert_as_recorded(found)
    assert note is None or note in " ".join(found.notes)


def test_a_compressed_file_has_the_numbers_of_the_plain_one(tmp_path: Path) -> None:
    packed = gzip.compress(csv().encode())
    assert_as_recorded(read(tmp_path, packed, "log.csv.gz"))
    middle = csv().index("\n", 100) + 1
    members = gzip.compress(csv()[:middle].encode()) + gzip.compress(csv()[middle:].encode())
    assert_as_recorded(read(tmp_path, members, "log.csv.gz"))


@pytest.mark.parametrize(
    ("text", "options"),
    [
        (csv(time=lambda t: str(round(1e3 * t))), {"time_unit": "ms"}),
        (csv(time=lambda t: f"{1e3 * t:.3f}"), {"time_unit": "ms"}),
        (csv(time=lambda t: f"{1e6 * t:.1f}"), {"time_unit": "us"}),
        (csv(scale=DEGREES), {"units": "deg"}),
        (
            csv(headings=("__time", "/a/elbow/position", "/b/elbow/position")),
            {"topics": {"state": "/a", "command": "/b"}},
        ),
        (
            csv(headings=("t", "q [deg]", "u [deg]"), scale=DEGREES),
            {"columns": {"t": "time", "q [deg]": "elbow.position", "u [deg]": "elbow.command"}},
        ),
    ],
)
def test_an_option_says_what_the_file_does_not(
    tmp_path: Path, text: str, options: dict[str, object]
) -> None:
    assert_as_recorded(read(tmp_path, text, **options))


REFUSED = {
    "milliseconds with a point": (csv(time=lambda t: f"{1e3 * t:.1f}"), "--time-unit s, ms, us"),
    "microseconds from zero": (csv(time=lambda t: str(round(1e6 * t))), "100 Hz as us"),
    "times with too few digits": (
        csv(time=lambda t: f"{1.7e9 + t:.1e}"), "the times do not advance (got '1.7e+09 in all 40"
    ),
    "degrees without a unit": (csv(scale=DEGREES), "--units deg or --units rad"),
    "commas and points": (csv(";", cell=comma), "numbers have commas and points"),
    "thousands": ("time;a.position\n0;1,234\n1;2,345\n", "may be a decimal mark or separate"),
    "a quote without an end": (csv() + '0.5,"1,2\n', "not CSV"),
    "topics of PlotJuggler": (
        csv(headings=("__time", "/a/elbow/position", "/b/elbow/position")),
        "--topics state=/a,command=/b",
    ),
    "two columns of times": (
        csv(headings=("time_s", "time_ms", "elbow.position")), "several columns of times"
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_may_be_read_in_two_ways_is_asked_for(tmp_path: Path, case: str) -> None:
    text, words = REFUSED[case]
    with pytest.raises(FormatError) as caught:
        read(tmp_path, text)
    assert words in str(caught.value)


def test_declared_signals_say_what_large_positions_are(tmp_path: Path) -> None:
    found = read(tmp_path, csv(scale=DEGREES), has_signals=True).series["state"].position
    assert found is not None
    assert float(found.max()) == pytest.approx(DEGREES, rel=1e-3)


def test_an_unknown_unit_leaves_a_column_out_with_a_note(tmp_path: Path) -> None:
    text = csv(headings=("time", "elbow.position [counts]", "elbow.command"))
    found = read(tmp_path, text)
    assert "state" not in found.series
    assert "counts is no unit that is converted" in " ".join(found.notes)


@given(
    st.sampled_from(sorted(TIME_UNITS)),
    # Whole microseconds at 1 Hz are those of whole nanoseconds at 1 kHz.
    st.floats(1.2, 5000.0),
    st.sampled_from([0.0, 12.5, 3e6, 1.7e9]),
    st.booleans(),
)
@settings(deadline=None, max_examples=300)
def test_a_unit_of_times_is_right_or_asked_for_or_noted(
    unit: str, rate: float, start: float, whole: bool
) -> None:
    times = (start + np.arange(50) / rate) * 1e9 / TIME_UNITS[unit]
    if whole:
        times = np.rint(times)
    if len(np.unique(times)) < 2:
        return
    try:
        found, note = unit_of_times(times, whole=whole)
    except TimeUnitError:
        return
    assert found == unit or note


@pytest.mark.parametrize("rate", [6.0, 10.0, 30.0, 50.0, 100.0, 500.0, 1000.0])
@pytest.mark.parametrize("start", [0.0, 3e6, 1.7e9])
def test_seconds_and_whole_nanoseconds_need_no_option(rate: float, start: float) -> None:
    times = start + np.arange(50) / rate
    assert unit_of_times(times, whole=False) == ("s", "")
    assert unit_of_times(np.rint(times * 1e9), whole=True)[0] == "ns"


def test_metadata_beside_a_csv_file_are_those_of_the_trial(tmp_path: Path) -> None:
    (tmp_path / "log.csv.yaml").write_text("role: held_out\npayload: kg05\ntemperature: 20 C\n")
    found = read(tmp_path, csv())
    assert found.metadata == {"role": "held_out", "payload": "kg05", "temperature": "20 C"}
    assert "metadata of the trial from log.csv.yaml" in found.notes


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[]\n", "not the metadata of a trial"),
        ("payload: {mass: 1}\n", "payload: not a value of a trial's metadata"),
        ("".join(f"k{n}: 1\n" for n in range(200)), "too many entries"),
        ("payload: a\npayload: b\n", "log.csv.yaml:2"),
    ],
)
def test_invalid_metadata_beside_a_file_are_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "log.csv.yaml").write_text(text)
    with pytest.raises(FormatError) as caught:
        read(tmp_path, csv())
    assert words in str(caught.value)


def test_a_small_file_that_unpacks_to_a_large_one_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "CSV", replace(limits.CSV, unpacked_free_bytes=2**20))
    packed = gzip.compress(csv().encode() + b"0.5,1,1\n" * 2**20)
    with pytest.raises(LimitError, match="too large after decompression"):
        read(tmp_path, packed, "log.csv.gz")


@pytest.mark.parametrize("cut", [5, 40, -4])
def test_a_damaged_compressed_file_is_refused(tmp_path: Path, cut: int) -> None:
    with pytest.raises(FormatError, match=r"gzip|compressed"):
        read(tmp_path, gzip.compress(csv().encode())[:cut], "log.csv.gz")
    with pytest.raises(FormatError, match="not a gzip file"):
        read(tmp_path, csv(), "log.csv.gz")


@pytest.mark.parametrize(
    "header",
    [
        "time,a.position " + "(a" * 400_000,
        "time,a.position (" + "a" * 900_000,
        "time," + "/a" * 450_000,
        ",".join(["time", *(f"j{n}.position" for n in range(8000))]),
        "#\n" * 200,
    ],
)
def test_a_hostile_header_is_refused_quickly(tmp_path: Path, header: str) -> None:
    with pytest.raises((FormatError, LimitError)):
        read(tmp_path, header + "\n0.0,1\n")
