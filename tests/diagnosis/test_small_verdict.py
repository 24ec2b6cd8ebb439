"""What small corrections do to the verdict, and how alternatives and corrections are worded."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from pytest_twin.diagnosis.verdict import JointError, verdict
from pytest_twin.report.diagnosis import headline
from pytest_twin.report.finding_words import place_of_set


@dataclass(frozen=True)
class Named:
    """As much of a finding as a verdict reads."""

    small: str = ""


SMALL, LARGE = Named("within the usual accuracy"), Named()


@pytest.mark.parametrize(
    ("before", "after", "findings", "word"),
    [
        (9e-4, 1e-4, [SMALL], "no_mismatch"),
        (5e-3, 1e-4, [SMALL], "explained"),
        (5e-3, 4e-3, [SMALL], "unexplained"),
        (9e-4, 1e-4, [SMALL, LARGE], "explained"),
        (5e-3, 4e-3, [SMALL, LARGE], "improved"),
        (9e-4, 9e-4, [], "unexplained"),
    ],
)
def test_small_corrections_alone_are_no_mismatch_of_consequence(
    before: float, after: float, findings: list[Named], word: str
) -> None:
    error = JointError(before, after, 1e-4, "rad", travel=1.0)
    assert verdict({"elbow": error}, findings) == word


def test_without_known_travel_only_the_noise_floor_counts() -> None:
    assert verdict({"elbow": JointError(9e-4, 1e-4, 1e-4, "rad")}, [SMALL]) == "explained"


def test_a_set_is_named_with_all_its_effects_and_what_it_replaces() -> None:
    said = {
        "effect": "payload",
        "joint": None,
        "together_with": [{"effect": "viscous_friction", "joint": "j1"}],
        "instead_of": [
            {"effect": "torque_constant", "joint": "j1"}, {"effect": "armature", "joint": "j1"},
        ],
    }  # fmt: skip
    assert place_of_set(said) == (
        "payload and viscous friction at joint j1 instead of torque constant at joint j1 and "
        "armature at joint j1"
    )


def test_the_headline_says_that_an_error_is_of_no_consequence() -> None:
    said = {"verdict": "no_mismatch", "small_corrections": [{}]}
    assert "consequence" in headline(said)
    assert "noise floor" in headline({"verdict": "no_mismatch", "small_corrections": []})
