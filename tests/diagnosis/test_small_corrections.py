"""Small corrections: their verdict, their headline and the words for alternative sets."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from pytest_twin.diagnosis.verdict import JointError, stated_verdict, verdict
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


@pytest.mark.parametrize(
    ("floors", "expected"),
    [(1.05, "explained"), (3.0, "explained"), (3.1, "improved"), (4.4, "improved")],
)
def test_only_a_residual_at_the_noise_floor_is_called_explained(
    floors: float, expected: str
) -> None:
    """A wrong effect often removes 98 % of the squared error and leaves several floors."""
    errors = {
        "shoulder": JointError(3e-4, 2e-4, 2e-4, "rad"),
        "elbow": JointError(50 * 2e-4, floors * 2e-4, 2e-4, "rad"),
    }
    of_search = verdict(errors, [LARGE])
    assert of_search == "explained", "the search may end"
    assert stated_verdict(of_search, errors) == expected


def test_the_headline_has_the_residual_in_noise_floors_and_the_windows_of_its_measurement() -> None:
    error = {"rms_before": 0.01, "rms_after": 2.4e-4, "floor": 2e-4, "unit": "rad"}
    diagnosis = {"verdict": "explained", "held_out": {"elbow": error}, "tested_windows": None}
    assert headline(diagnosis) == (
        "Explained: with these findings the residual is at the noise floor "
        "(at most 1.2 noise floors)"
    )
    slipping = {**error, "rms_after": 8.8e-4}
    of_windows = {
        "verdict": "improved",
        "held_out": {"shoulder": error, "elbow": slipping},
        "tested_windows": 0.5,
    }
    assert headline(of_windows).endswith(
        "a residual remains (at most 4.4 noise floors at elbow, over windows of 0.5 s)"
    )


def test_the_headline_names_the_longest_windows_that_the_model_follows() -> None:
    error = {"rms_before": 0.01, "rms_after": 2e-4, "floor": 2e-4, "unit": "rad"}
    longer = {"seconds": 4.0, "held_out": {"elbow": {**error, "rms_after": 1.6e-3}}}
    diagnosis = {
        "verdict": "improved", "held_out": {"elbow": error}, "tested_windows": 0.5,
        "longest_windows": longer,
    }  # fmt: skip
    assert headline(diagnosis).endswith("(at most 8 noise floors, over windows of 4 s)")
