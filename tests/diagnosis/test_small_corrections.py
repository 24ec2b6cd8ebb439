"""Small corrections: their verdict, their headline and the words for alternative sets."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from pytest_twin.diagnosis.verdict import JointError, verdict
from pytest_twin.report.diagnosis import headline
from pytest_twin.report.finding_words import place_of_set


@dataclass(frozen=True)
class FindingStub:
    """The part of a finding that the verdict depends on."""

    small: str = ""


SMALL, LARGE = FindingStub("within the usual accuracy"), FindingStub()


@pytest.mark.parametrize(
    ("before", "after", "findings", "expected"),
    [
        (9e-4, 1e-4, [SMALL], "no_mismatch"),
        (5e-3, 1e-4, [SMALL], "explained"),
        (5e-3, 4e-3, [SMALL], "unexplained"),
        (9e-4, 1e-4, [SMALL, LARGE], "explained"),
        (5e-3, 4e-3, [SMALL, LARGE], "improved"),
        (9e-4, 9e-4, [], "unexplained"),
    ],
    ids=[
        "small error removed by a small correction",
        "large error removed by a small correction",
        "large error not removed by a small correction",
        "small error removed by a small and a large correction",
        "large error partly removed by a small and a large correction",
        "small error without findings",
    ],
)
def test_the_verdict_follows_from_the_errors_and_the_size_of_the_corrections(
    before: float, after: float, findings: list[FindingStub], expected: str
) -> None:
    error = JointError(before, after, 1e-4, "rad", travel=1.0)
    assert verdict({"elbow": error}, findings) == expected


def test_without_a_known_travel_an_error_is_small_only_below_the_noise_floor() -> None:
    assert verdict({"elbow": JointError(9e-4, 1e-4, 1e-4, "rad")}, [SMALL]) == "explained"


def test_an_alternative_set_is_described_by_its_effects_and_those_it_replaces() -> None:
    alternative = {
        "effect": "payload",
        "joint": None,
        "together_with": [{"effect": "viscous_friction", "joint": "j1"}],
        "instead_of": [
            {"effect": "torque_constant", "joint": "j1"}, {"effect": "armature", "joint": "j1"},
        ],
    }  # fmt: skip
    assert place_of_set(alternative) == (
        "payload and viscous friction at joint j1 instead of torque constant at joint j1 and "
        "armature at joint j1"
    )


def test_the_headline_of_small_corrections_says_that_the_error_has_no_consequence() -> None:
    diagnosis = {"verdict": "no_mismatch", "small_corrections": [{}]}
    assert "consequence" in headline(diagnosis)
    assert "noise floor" in headline({"verdict": "no_mismatch", "small_corrections": []})
