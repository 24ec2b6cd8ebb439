"""Categories of an error budget, with the command and the experiment that measure each."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources

from pytest_twin.effects import Effect, catalogue


@dataclass(frozen=True, slots=True)
class Category:
    """One kind of cause.

    Attributes:
        id: id in ``budget.json`` and ``owners:``.
        command: command that measures it.
        next_test: experiment that distinguishes its causes, or reduces their uncertainty.
        goldens: kinds of golden that test it.
    """

    id: str
    metric: str
    command: str
    next_test: str
    goldens: Sequence[str] = ()

    @property
    def words(self) -> str:
        """Readable name."""
        return self.id.replace("_", " ")


def _categories() -> tuple[Category, ...]:
    text = resources.files(__package__).joinpath("categories.toml").read_text("utf-8")
    return tuple(Category(name, **fields) for name, fields in tomllib.loads(text).items())


CATEGORIES = _categories()
_OF_RECORD = {
    "base_world": "frame_calibration",
    "robot_world": "frame_calibration",
    "tcp": "frame_calibration",
    "hand_eye": "frame_calibration",
    "joint_zeros": "frame_calibration",
    "fixture": "environment_and_object",
    "geometry": "asset_and_geometry",
    "time_offset": "timing",
}
_OF_FAMILY = {
    "timing": "timing",
    "sensing": "sensing",
    "actuation": "actuation",
    "friction": "friction_and_transmission",
    "transmission": "friction_and_transmission",
    "rigid_body": "rigid_body_dynamics",
    "contact": "contact_and_material",
    "environment": "environment_and_object",
}
"""Family of an effect -> category."""
_OF_NAME = {
    "effort_delay": "timing",
    "effort_lag": "timing",
    "servo_stiffness": "actuation",
    "servo_damping": "actuation",
    "contact_torsional_friction": "contact_and_material",
    "contact_rolling_friction": "contact_and_material",
}
"""Category of parameters that belong to no effect of the catalogue."""


def category_of_record(name: str) -> str:
    """Return the category of one record of a calibration."""
    return _OF_RECORD[name]


def category_of_parameter(name: str) -> str:
    """Return the category of an identified parameter: ``JOINT.EFFECT``, or an expression."""
    words = name.split(".")
    # Parameters of sensors have names such as wrist.sensor_bias_fx.
    if any(word.startswith("sensor_") and word not in catalogue() for word in words[1:]):
        return "timing" if words[-1] == "sensor_filter_time" else "sensing"
    for word in words[1:]:
        if word in _OF_NAME:
            return _OF_NAME[word]
        if word in catalogue():
            return _category_of_effect(catalogue()[word])
    if any("friction" in word for word in words[1:]):
        return "friction_and_transmission"
    return "rigid_body_dynamics"


def _category_of_effect(effect: Effect) -> str:
    """Return the category of an effect: that of its family, unless its traits say another one."""
    if effect.needs_effort_sensor:
        return "actuation"
    if effect.family == "transmission" and any(
        "stiffness" in (p.quantity, (p.reciprocal_of or ("", ""))[1]) for p in effect.parameters
    ):
        return "compliance_and_backlash"
    return _OF_FAMILY[effect.family]
