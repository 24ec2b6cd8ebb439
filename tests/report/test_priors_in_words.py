"""What became of the priors of servos, in words."""

from __future__ import annotations

from typing import Any

import pytest

from pytest_twin.report.priors import prior_sentences

KNOWN: dict[str, Any] = {
    "servo": "mine", "joint": "elbow", "parameter": "stiffness", "unit": "N*m/rad",
    "value": 13.5, "ci95": [12.7, 14.2], "model": 13.5,
}  # fmt: skip


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ({"state": "not_estimated"}, "no effect found changes it, and the model has 13.5."),
        ({"state": "not_estimated", "model": 20.0}, "the model has 20, outside this interval."),
        ({"state": "not_estimated", "model": None}, "and the model has no limit."),
        ({"state": "not_comparable", "why": "it slides"}, "not used: it slides."),
        (
            {"state": "combined", "combined": {"value": 13.4, "ci95": [12.8, 14.0]}},
            "do not determine it; together 13.4 (95 % interval 12.8 to 14).",
        ),
        (
            {
                "state": "contradicted", "distance": 7.0, "why": "not used: they contradict it",
                "data": {"value": 8.0, "ci95": [7.9, 8.1]},
            },
            "alone say 8 (95 % interval 7.9 to 8.1), 7 standard deviations away; not used: they "
            "contradict it.",
        ),
    ],
)  # fmt: skip
def test_each_outcome_has_a_sentence(more: dict[str, Any], expected: str) -> None:
    (sentence,) = prior_sentences({"priors": [{**KNOWN, **more}]})
    assert sentence.startswith("Prior: stiffness of elbow as of servo mine, 13.5 (95 % interval ")
    assert sentence.endswith(expected)


def test_joints_with_the_same_outcome_share_a_sentence() -> None:
    uses = [{**KNOWN, "joint": joint, "state": "not_estimated"} for joint in ("hip", "knee")]
    (sentence,) = prior_sentences({"priors": uses})
    assert "stiffness of hip, knee as of servo mine" in sentence


def test_without_priors_nothing_is_said() -> None:
    assert prior_sentences({}) == []
