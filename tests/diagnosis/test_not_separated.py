"""Names that recordings do not separate, and the command for the motion that does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pytest_twin.diagnosis.not_separated import not_separated, state_not_separated
from pytest_twin.report.finding_words import to_confirm


def finding(effect: str, confidence: float, *others: Any, joint: str | None = "elbow") -> Any:
    """A finding with alternatives (effect, confidence) at the same joint."""
    return {
        "effect": effect, "joint": joint, "confidence": confidence, "next_test": "reverse slowly",
        "alternatives": [
            {"effect": name, "joint": joint, "confidence": share} for name, share in others
        ],
    }  # fmt: skip


def names(one: Any) -> list[str]:
    return [each["name"] for each in not_separated(one)]


def test_the_smallest_set_of_names_that_holds_90_percent_is_stated() -> None:
    one = finding(
        "coulomb_friction", 0.55, ("dead_zone", 0.05), ("stribeck_friction", 0.36),
        ("backlash", 0.04),
    )  # fmt: skip
    assert names(one) == ["coulomb_friction@elbow", "stribeck_friction@elbow"]
    assert names(finding("coulomb_friction", 0.93, ("stribeck_friction", 0.05))) == []


def test_an_alternative_that_is_likelier_than_the_finding_is_first() -> None:
    for own, other in ((0.3, 0.65), (0.03, 0.97)):
        one = finding("coulomb_friction", own, ("stribeck_friction", other))
        assert names(one) == ["stribeck_friction@elbow", "coulomb_friction@elbow"]


@pytest.mark.parametrize(
    ("others", "expected"),
    [
        ([("stribeck_friction", 0.02)], []),
        ([("stribeck_friction", 0.2)], ["coulomb_friction@elbow", "stribeck_friction@elbow"]),
    ],
)
def test_under_a_limited_confidence_only_likely_names_count(
    others: list[tuple[str, float]], expected: list[str]
) -> None:
    assert names(finding("coulomb_friction", 0.5, *others)) == expected


def test_several_effects_of_one_explanation_are_one_name() -> None:
    one = finding("base_tilt", 0.5, ("coulomb_friction", 0.45), joint=None)
    one["alternatives"][0] |= {
        "joint": "lift", "together_with": [{"effect": "backlash", "joint": "elbow"}],
    }  # fmt: skip
    assert names(one) == ["base_tilt", "coulomb_friction@lift+backlash@elbow"]
    document = {"findings": [one]}
    state_not_separated(document, Path("twin.yaml"), Path("out"))
    assert "command" not in one["not_separated"]
    assert one["next_test"] == "reverse slowly"


def test_the_command_is_written_out_from_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    one = finding("coulomb_friction", 0.5, ("stribeck_friction", 0.45))
    folder = tmp_path / "my diagnosis"
    state_not_separated({"findings": [one]}, tmp_path / "arm" / "twin.yaml", folder)
    command = (
        "pytest-twin excite arm/twin.yaml --separate "
        "coulomb_friction@elbow,stribeck_friction@elbow --diagnosis 'my diagnosis' "
        "--out separating_motion"
    )
    assert one["not_separated"]["command"] == command
    assert one["not_separated"]["share"] == pytest.approx(0.95)
    assert to_confirm(one) == f"To confirm: reverse slowly; or {command}"


def test_a_contact_is_a_name_without_a_motion() -> None:
    one = finding("contact_friction", 0.5, ("coulomb_friction", 0.45))
    state_not_separated({"findings": [one]}, Path("twin.yaml"), Path("out"))
    assert len(one["not_separated"]["names"]) == 2
    assert "command" not in one["not_separated"]
