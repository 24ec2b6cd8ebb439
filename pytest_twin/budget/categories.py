"""Categories of an error budget, with the command and the experiment that measure each."""

from __future__ import annotations

from dataclasses import dataclass

from pytest_twin.effects import catalogue


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
    goldens: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """Readable name."""
        return self.id.replace("_", " ")


_IDENTIFY = "pytest-twin identify MODEL RECORDING... --held-out RECORDING... --out DIR"
_CALIBRATE = "pytest-twin calibrate PLAN.yaml --out DIR"
_DIAGNOSE = "pytest-twin diagnose MODEL RECORDING... --out DIR"

CATEGORIES: tuple[Category, ...] = (
    Category(
        "asset_and_geometry",
        "deviations of links from the drawing",
        f"{_CALIBRATE}, with estimate: [geometry]",
        "measure tool positions with a tracker over the whole workspace, and fit the geometry",
        ("fk", "limits", "joint_direction"),
    ),
    Category(
        "frame_calibration",
        "joint zeros, base, tool and camera frames",
        f"{_CALIBRATE}, with estimate: [joint_zeros, base_world, tcp, hand_eye]",
        "add the poses that next_poses of the calibration names, and hold out a third of them",
        ("calibration", "tcp_accuracy"),
    ),
    Category(
        "timing",
        "delays and offsets between clocks",
        f"{_IDENTIFY} (stage delay), or {_CALIBRATE}, with streams: and estimate: [time_offset]",
        "repeat one path at two speeds: a delay moves the tool in proportion to the speed",
        ("replay", "sensor_timing"),
    ),
    Category(
        "sensing",
        "encoder zeros and scales, biases and couplings of other sensors",
        f"{_IDENTIFY} (stage encoder; --sensor for force-torque sensors and IMUs)",
        "hold each joint at both ends of its range and compare with an outside measurement",
        ("replay",),
    ),
    Category(
        "actuation",
        "constant efforts and scales of the drives",
        f"{_IDENTIFY} (stage drive)",
        "repeat the recording with a known payload: it determines the scale of each drive",
        ("step", "frequency_response"),
    ),
    Category(
        "rigid_body_dynamics",
        "base parameters: masses, first and second moments, armatures",
        f"pytest-twin excite MODEL --out DIR, then {_IDENTIFY}",
        "run the D-optimal motions of pytest-twin excite, and hold out one of them",
        ("mass_properties", "identification"),
    ),
    Category(
        "friction_and_transmission",
        "viscous and Coulomb friction of the joints",
        f"pytest-twin excite MODEL --out DIR, then {_IDENTIFY}",
        "slow reversals and two constant speeds of each joint, cold and warm",
        ("identification", "replay"),
    ),
    Category(
        "compliance_and_backlash",
        "elasticity and backlash between motor and link",
        _DIAGNOSE,
        "push the tool with the motors held, in both directions, and measure where it goes",
        ("settling",),
    ),
    Category(
        "contact_and_material",
        "friction, stiffness and damping of contacts",
        f"{_IDENTIFY} with tosses, or {_DIAGNOSE} with recordings that touch something",
        "touch, press and slide at two speeds and two loads",
        ("contact",),
    ),
    Category(
        "environment_and_object",
        "where fixtures and objects are",
        f"{_CALIBRATE}, with estimate: [fixture]",
        "measure the fixture again after it has been taken off and put back",
        ("collision_distance",),
    ),
    Category(
        "unmodelled",
        "held-out error beyond what the uncertainty of the estimates explains",
        f"{_CALIBRATE}, or {_IDENTIFY}, with recordings or observations held out",
        f"{_DIAGNOSE}, on the held-out recordings",
        ("replay", "task"),
    ),
)

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
    "effort_bias": "actuation",
    "effort_scale": "actuation",
    "servo_stiffness": "actuation",
    "servo_damping": "actuation",
    "backlash": "compliance_and_backlash",
    "joint_elasticity": "compliance_and_backlash",
    "joint_spring": "compliance_and_backlash",
    "contact_torsional_friction": "contact_and_material",
    "contact_rolling_friction": "contact_and_material",
}
"""Category of each name that is no effect, and of each effect that differs from its family."""


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
            return _OF_FAMILY[catalogue()[word].family]
    if any("friction" in word for word in words[1:]):
        return "friction_and_transmission"
    return "rigid_body_dynamics"
