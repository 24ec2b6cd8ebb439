"""Counts and lists in sentences."""

from __future__ import annotations

import pytest

from pytest_twin.words import counted, join_words, list_names


@pytest.mark.parametrize(
    ("words", "sentence"),
    [([], ""), (["a"], "a"), (["a", "b"], "a or b"), (["a", "b", "c"], "a, b or c")],
)
def test_the_last_word_of_a_list_follows_the_conjunction(words: list[str], sentence: str) -> None:
    assert join_words(words, "or") == sentence


def test_a_long_list_ends_with_the_number_of_names_that_it_leaves_out() -> None:
    assert list_names(["a", "b", "c"], 2) == "a, b and 1 more"
    assert list_names(["a", "b"], 2, "; ") == "a; b"


def test_a_count_of_one_has_a_noun_in_singular() -> None:
    assert (counted(1, "file"), counted(0, "file")) == ("1 file", "0 files")
