"""Position of each effect on the signal path from command to sensor reading."""

from __future__ import annotations

import pytest

from pytest_twin.effects import catalogue


@pytest.mark.parametrize(
    ("path", "effects"),
    [
        ("command", {"command_delay"}),
        (
            "actuator",
            {"torque_saturation", "watchdog_timeout", "cogging", "actuator_lag", "rate_limit"},
        ),
        ("transmission", {"backlash", "stribeck_friction", "joint_coupling"}),
        ("rigid body", {"payload", "armature"}),
        ("sensor", {"sensor_delay", "clock_drift", "encoder_bias", "effort_scale"}),
        ("contact", {"contact_friction"}),
        ("surroundings", {"external_force"}),
    ],
)
def test_effects_are_assigned_to_the_expected_signal_path(path: str, effects: set[str]) -> None:
    assert {e for e in effects if catalogue()[e].path == path} == effects


def test_every_effect_states_its_signal_path() -> None:
    assert all(effect.path for effect in catalogue().values())
