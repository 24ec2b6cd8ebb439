"""Where effects sit between command and reading."""

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
def test_every_path_has_its_effects(path: str, effects: set[str]) -> None:
    assert {e for e in effects if catalogue()[e].path == path} == effects


def test_every_effect_has_a_path() -> None:
    assert all(effect.path for effect in catalogue().values())
