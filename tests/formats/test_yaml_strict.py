"""Strict YAML: unambiguous values, and errors with line and column."""

from __future__ import annotations

import math
import string
from pathlib import Path
from typing import Any

import pytest
import yaml as pyyaml
from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_twin.errors import FormatError, LimitError
from pytest_twin.formats import yaml

PATH = Path("twin.yaml")


@pytest.fixture(params=["libyaml", "python"], autouse=True)
def parser(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "python":
        monkeypatch.setattr(yaml, "_Parser", pyyaml.Loader)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-6", 1e-6),
        ("1.e3", 1000.0),
        ("-.5", -0.5),
        ("+12", 12),
        ("0o17", 15),
        ("0x1F", 31),
        ("017", 17),
        ("no", "no"),
        ("on", "on"),
        ("Yes", "Yes"),
        ("true", True),
        ("FALSE", False),
        ("~", None),
        ("", None),
        ("12:30:45", "12:30:45"),
        ("2020-01-01", "2020-01-01"),
        ("1_000", "1_000"),
        ("0b11", "0b11"),
        ("=", "="),
        ("'1e-6'", "1e-6"),
        ('"true"', "true"),
        ("0.5 mm", "0.5 mm"),
        ("-0.0", -0.0),
    ],
)
def test_plain_scalars_follow_the_core_schema(text: str, value: object) -> None:
    found = yaml.loads(f"a: {text}\n", PATH).data["a"]
    assert found == value
    assert type(found) is type(value)


def test_each_field_has_the_line_of_its_key() -> None:
    text = "a: 1\n\nb:\n  c:\n    - x\n    - d: 2\n  e:\n    long\n"
    lines = yaml.loads(text, PATH).lines
    assert lines == {
        "": 1,
        "a": 1,
        "b": 3,
        "b.c": 4,
        "b.c.0": 5,
        "b.c.1": 6,
        "b.c.1.d": 6,
        "b.e": 7,
    }


@pytest.mark.parametrize(
    ("text", "line", "column", "words"),
    [
        ("a: 1\nb: 2\na: 3\n", 3, 1, "key 'a' occurs a second time (first: 1)"),
        ("a: {b: 1, b: 2}", 1, 11, "key 'b' occurs a second time"),
        ("a: &x 1\n", 1, 4, "an anchor (&name)"),
        ("a: *x\n", 1, 4, "an alias (*name)"),
        ("a: !!python/object:os.system x\n", 1, 4, "a tag"),
        ("a: !!str 1\n", 1, 4, "a tag"),
        ("a:\n  <<: {b: 1}\n", 2, 3, "a merge key (<<)"),
        ("? [1, 2]\n: 3\n", 1, 3, "a key that is not text"),
        ("'': 3\n", 1, 1, "an empty key"),
        ("a: .nan\n", 1, 4, ".nan is not a finite number"),
        ("a: -.INF\n", 1, 4, "-.INF is not a finite number"),
        ("a: 1e999\n", 1, 4, "number 1e999 is out of range"),
        ("a: 99999999999999999999\n", 1, 4, "an integer that is out of range"),
        ("a: " + "9" * 5000, 1, 4, "an integer that is out of range"),
        ("a: 1\n---\nb: 1\n", 2, 1, "a second document"),
        ("a: 1\n\tb: 2\n", 2, 1, "not YAML"),
        ("a: [1,\n", 2, 1, "not YAML"),
        ("a: 1\nb: x\0y\n", 2, 5, "a character that YAML text may not contain"),
        ("a: \x1b[31m\n", 1, 4, "a character that YAML text may not contain"),
        ("a: 1\rb: 2\n", 1, 5, "a character that YAML text may not contain"),
        ("a: x\u2028y\n", 1, 5, "a character that YAML text may not contain"),
        ("", 1, None, "empty file"),
        ("# only a comment\n", 1, None, "empty file"),
    ],
)
def test_invalid_or_ambiguous_yaml_is_refused_with_line_and_column(
    text: str, line: int, column: int | None, words: str
) -> None:
    with pytest.raises(FormatError) as caught:
        yaml.loads(text, PATH)
    assert words in str(caught.value)
    assert (caught.value.line, caught.value.column) == (line, column)
    assert str(caught.value).startswith(f"twin.yaml:{line}")


def test_a_tag_directive_is_refused() -> None:
    with pytest.raises(FormatError, match="a %TAG directive"):
        yaml.loads("%TAG ! tag:x,2000:\n---\na: 1\n", PATH)


def test_nesting_depth_of_yaml_is_limited() -> None:
    assert yaml.loads("[" * 32 + "]" * 32, PATH)
    with pytest.raises(LimitError, match="nested too deep"):
        yaml.loads("[" * 33 + "]" * 33, PATH)
    with pytest.raises(LimitError, match="nested too deep"):
        yaml.loads("[" * 1_000_000, PATH)


def test_the_number_of_yaml_values_is_limited() -> None:
    with pytest.raises(LimitError, match="too many values"):
        yaml.loads("[" + "1," * 200_001 + "]", PATH)


def test_a_too_large_yaml_file_is_refused_before_reading(tmp_path: Path) -> None:
    path = tmp_path / "big.yaml"
    with path.open("wb") as stream:
        stream.truncate(2**40)
    with pytest.raises(LimitError, match="file is too large"):
        yaml.load(path)


def test_invalid_utf8_in_yaml_is_reported_with_line_and_column(tmp_path: Path) -> None:
    path = tmp_path / "twin.yaml"
    path.write_bytes(b"a: 1\nb: \xc3\xa9\xff\n")
    with pytest.raises(FormatError, match="not UTF-8 text") as caught:
        yaml.load(path)
    assert (caught.value.line, caught.value.column) == (2, 5)


def test_yaml_with_byte_order_mark_and_crlf_is_read(tmp_path: Path) -> None:
    path = tmp_path / "twin.yaml"
    path.write_bytes(b"\xef\xbb\xbfa: 1\r\nb: x\r\n")
    assert yaml.load(path).data == {"a": 1, "b": "x"}


_TEXT = st.text(st.sampled_from(string.printable + "éß→𝄞\x85\u2028\ufeff"), max_size=12)
_DATA = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | _TEXT,
    lambda inner: (
        st.lists(inner, max_size=6) | st.dictionaries(_TEXT.filter(bool), inner, max_size=4)
    ),
    max_leaves=25,
)


def _same(left: Any, right: Any) -> bool:
    if isinstance(left, float):
        return (
            type(right) is float
            and math.copysign(1, left) == math.copysign(1, right)
            and (left == right)
        )
    if isinstance(left, list):
        return len(left) == len(right) and all(map(_same, left, right))
    if isinstance(left, dict):
        return list(left) == list(right) and all(_same(left[k], right[k]) for k in left)
    return type(left) is type(right) and left == right


@settings(max_examples=60, deadline=None)
@given(expected=_DATA)
def test_recorded_data_is_read_back_unchanged(expected: Any) -> None:
    text = yaml.rewrite_recorded("kind: fk\n", {"expected": expected})
    data = yaml.loads(text, PATH).data
    assert data["kind"] == "fk"
    assert _same(expected, data["expected"])
    assert text == yaml.rewrite_recorded(text, {"expected": expected})
    assert yaml.rewrite_recorded(text, {}) == "kind: fk\n"


@pytest.mark.parametrize("name", ["1e3", "0o17", "yes", "~", "12:30", "a: b", "-", ""])
def test_a_name_that_looks_like_another_value_stays_text(name: str) -> None:
    assert yaml.loads(yaml.dump({"tcp": name}), PATH).data == {"tcp": name}
