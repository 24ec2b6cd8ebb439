"""The recorded block at the end of a golden spec; the part written by people is unchanged."""

from __future__ import annotations

from pathlib import Path

import pytest

from pytest_twin.errors import SpecError
from pytest_twin.formats import yaml
from pytest_twin.formats.yaml import RECORDED_MARK, rewrite_recorded

HUMAN = "# why: the drawing, sheet 3\nkind:   fk   # kept\n\ntolerance: {position: 0.5 mm}\n"
RECORDED = {
    "provenance": {"recorded_by": "no one", "recorded_at": "2026-01-01T00:00:00Z"},
    "expected": {"tcp": [0.1, 1e-9, -3], "empty": {}, "poses": [{"a": 1.0, "b": [[1.0], []]}]},
}
WRITTEN = f"""\
{RECORDED_MARK}
expected:
  tcp: [0.1, 1.0e-09, -3]
  empty: {{}}
  poses:
    - a: 1.0
      b: [[1.0], []]
provenance:
  recorded_by: no one
  recorded_at: "2026-01-01T00:00:00Z"
"""


def test_the_recorded_block_is_appended_in_a_fixed_order() -> None:
    assert rewrite_recorded(HUMAN, RECORDED) == HUMAN + WRITTEN


def test_the_recorded_block_is_replaced_as_a_whole() -> None:
    old = rewrite_recorded(HUMAN, {**RECORDED, "trace": {"file": "a.csv", "sha256": "0" * 64}})
    assert rewrite_recorded(old, RECORDED) == HUMAN + WRITTEN


def test_the_part_written_by_people_keeps_its_bytes_with_crlf() -> None:
    human = HUMAN.replace("\n", "\r\n")
    text = rewrite_recorded(human, RECORDED)
    assert text.startswith(human)
    assert text == human + WRITTEN.replace("\n", "\r\n")
    assert rewrite_recorded(text, RECORDED) == text


def test_a_missing_final_newline_is_added() -> None:
    assert rewrite_recorded("kind: fk", {"expected": 1}).startswith("kind: fk\n# ---")


def test_long_lists_are_wrapped_to_100_columns_and_read_back() -> None:
    values = [index / 7 for index in range(200)]
    text = rewrite_recorded(HUMAN, {"expected": {"a": values, "b": [values, [1.0]]}})
    assert max(map(len, text.splitlines())) <= 100
    assert yaml.loads(text, Path("x")).data["expected"] == {"a": values, "b": [values, [1.0]]}


@pytest.mark.parametrize(
    ("text", "line", "where", "words"),
    [
        ("kind: fk\nexpected: {}\n", 2, "expected", "above the recorded mark"),
        (f"expected: 1\n{RECORDED_MARK}\n", 1, "expected", "above the recorded mark"),
        (
            f"kind: fk\n{RECORDED_MARK}\ntrace: {{}}\nnote: 1\n",
            4,
            "note",
            "below the recorded mark",
        ),
        ("{kind: fk}\n", 1, None, "fields cannot be appended"),
        ("kind: fk\n...\n", 1, None, "fields cannot be appended"),
        ("[1]\n", 1, None, "not a mapping of fields"),
    ],
)
def test_a_spec_whose_own_part_would_change_is_refused(
    text: str, line: int, where: str | None, words: str
) -> None:
    with pytest.raises(SpecError) as caught:
        rewrite_recorded(text, {"expected": 2}, Path("g.yaml"))
    assert words in str(caught.value)
    assert (caught.value.line, caught.value.where) == (line, where)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (float("nan"), "expected.a: not a finite number"),
        (b"x", "expected.a: a bytes cannot be written as YAML"),
        ({1: 2}, "expected.a: a key that is not text"),
    ],
)
def test_values_that_yaml_cannot_represent_are_refused(value: object, words: str) -> None:
    with pytest.raises(SpecError, match=words):
        rewrite_recorded(HUMAN, {"expected": {"a": value}})


def test_keys_that_are_not_recorded_are_refused() -> None:
    with pytest.raises(SpecError, match="tolerance: not a recorded key"):
        rewrite_recorded(HUMAN, {"tolerance": {}})
