"""What a finding says of itself in one sentence."""

from __future__ import annotations

from pytest_twin.report.diagnosis import finding_sentence

LAGS = {
    "effect": "actuator_lag",
    "joint": "Elbow_J2",
    "confidence": 1.0,
    "parameters": {
        "time_constant": {"value": 0.025, "unit": "s", "ci95": [0.024, 0.026]},
        "of_setpoint": {"value": 1.0, "unit": "1", "ci95": [1.0, 1.0]},
    },
    "held_out_gain": 0.995,
    "alternatives": [],
}


def test_joints_are_named_as_they_are_numbers_have_intervals_and_choices_none() -> None:
    assert finding_sentence(LAGS) == (
        "Actuator lag at Elbow_J2: time constant 0.025 s (0.024 to 0.026), of setpoint 1; "
        "confidence 100 %, takes 99.5 % off the error that stands without it."
    )


def test_what_adds_to_an_error_that_one_slide_is_most_of_says_so() -> None:
    said = finding_sentence(LAGS | {"held_out_gain": -0.12})
    assert said.endswith("confidence 100 %, adds 12 % to the error that stands without it.")
