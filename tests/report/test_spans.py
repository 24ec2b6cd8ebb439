"""Text of the time spans in which a finding is visible."""

from __future__ import annotations

from pytest_twin.report.diagnosis import spans_in_words


def test_a_few_time_spans_are_all_listed() -> None:
    assert spans_in_words([[0.5, 1.25], [3.0, 4.0]]) == "0.5 to 1.25, 3 to 4 s"


def test_of_many_time_spans_the_longest_are_listed_in_order() -> None:
    short = [[float(k), k + 0.1] for k in range(20)]
    said = spans_in_words([*short, [30.0, 40.0], [50.0, 55.0]])
    assert said.endswith("30 to 40, 50 to 55 s, and 14 shorter")
    assert said.count(" to ") == 8
