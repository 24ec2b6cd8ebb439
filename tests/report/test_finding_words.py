"""Sentences about a finding: quantity, gain, alternatives and next test."""

from __future__ import annotations

from typing import Any

import pytest

from pytest_twin.report.finding_words import ambiguity_sentence, finding_sentence, gain, to_confirm


def finding(effect: str, joint: str | None = "elbow", **parameters: Any) -> dict[str, Any]:
    """A finding as in ``diagnosis.json``; parameters are (value, unit, lower, upper)."""
    return {
        "effect": effect,
        "joint": joint,
        "confidence": 1.0,
        "parameters": {
            name: {"value": value, "unit": unit, "ci95": [low, high]}
            for name, (value, unit, low, high) in parameters.items()
        },
        "held_out_gain": 0.995,
        "alternatives": [],
        "next_test": "record slow reversals",
    }


@pytest.mark.parametrize(
    ("said", "sentence"),
    [
        (
            finding("command_delay", delay=(0.0148, "s", 0.0145, 0.0151)),
            "The command delay of joint elbow is 14.8 ms (95 % interval 14.5 to 15.1).",
        ),
        (
            finding("viscous_friction", coefficient=(-0.5, "N*m*s/rad", -0.6, -0.4)),
            "The viscous friction of joint elbow is 0.5 N*m*s/rad below the model's (95 % interval "
            "0.4 to 0.6).",
        ),
        (
            finding("viscous_friction", coefficient=(-0.1, "N*m*s/rad", -0.3, 0.1)),
            "The viscous friction of joint elbow is 0.1 N*m*s/rad below the model's (95 % interval "
            "0.3 below to 0.1 above).",
        ),
        (
            finding("torque_constant", relative_error=(0.12, "1", 0.1, 0.14)),
            "The torque constant of joint elbow is 12 % above the model's (95 % interval 10 to 14)"
            ".",
        ),
        (
            finding("encoder_scale", scale_error=(-2.0, "1", -2.01, -1.99)),
            "The encoder scale of joint elbow is 200 % below the model's: its sign is reversed, so "
            "compare the direction in the recording and the model (95 % interval 199 to 201).",
        ),
        (
            finding(
                "actuator_lag", time_constant=(0.025, "s", 0.024, 0.026), of_setpoint=(1, "1", 1, 1)
            ),
            "The lag time constant (lag of the setpoint) of joint elbow is 25 ms (95 % interval 24 "
            "to 26).",
        ),
        (
            finding("base_tilt", None, roll=(0.01, "rad", 0.0, 0.02), pitch=(0.3, "rad", 0.2, 0.4)),
            "Base tilt: roll about x 10 mrad (95 % interval 0 to 20), pitch about y 0.3 rad (95 % "
            "interval 0.2 to 0.4).",
        ),
        (
            finding("coulomb_friction", coulomb=(0.5, "N*m", 0.4, 0.6)),
            "The Coulomb friction of joint elbow is 0.5 N*m above the model's (95 % interval 0.4 "
            "to 0.6).",
        ),
        (
            finding("of_another_package", pull=(2.0, "N*m", 1.0, 3.0)),
            "The pull of joint elbow is 2 N*m (95 % interval 1 to 3).",
        ),
    ],
)
def test_a_finding_sentence_states_quantity_joint_value_unit_and_interval(
    said: dict[str, Any], sentence: str
) -> None:
    assert finding_sentence(said) == sentence


def test_the_gain_states_which_error_it_removes_or_adds() -> None:
    said = finding("command_delay")
    assert gain(said, held_out=True) == "removes 99.5 % of the remaining squared held-out error"
    assert gain(said | {"held_out_gain": -0.12}, held_out=False) == (
        "adds 12 % to the remaining squared fitted error"
    )


def test_names_that_the_recordings_do_not_separate_are_listed_with_their_shares() -> None:
    names = [
        {"name": "coulomb_friction@elbow", "confidence": 0.62},
        {"name": "stribeck_friction@elbow", "confidence": 0.3},
    ]
    said = finding("coulomb_friction") | {"not_separated": {"names": names, "share": 0.92}}
    assert ambiguity_sentence(said) == (
        "These recordings do not separate coulomb_friction@elbow (62 %) and "
        "stribeck_friction@elbow (30 %)."
    )
    assert ambiguity_sentence(finding("coulomb_friction")) == ""


def test_the_next_test_is_worded_as_an_instruction() -> None:
    assert to_confirm(finding("command_delay")) == "To confirm: record slow reversals."
