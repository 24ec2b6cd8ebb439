"""Validated models of three real machines, as tables of parameters.

A validated model is the folder's ``model.xml`` with the drive values of :data:`MACHINES`, and an
``effects.json`` with effects that MJCF cannot express. Sources of the values:

- EMPS: the published least-squares fit (Janot, Gautier, Brunot 2019).
- XL330: result of ``python benchmarks/real/xl330.py --gains 400`` without gain 400
(benchmarks/real/record.md); torque constant, rotor inertia and friction are additions to the
model's.
- SO-101: ``python benchmarks/concealed/real_fit.py``: least squares of one-second windows simulated
by MuJoCo, without code of pytest-twin. Joints that do not move in the chosen segments are welded
at their angle.

The recordings themselves are not included; they are read from ``TWIN_RECORDINGS``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace


@dataclass(frozen=True)
class Drive:
    """One joint and its drive, SI units.

    Attributes:
        damping, friction, armature: parameters of the joint.
        kp, kv: gains of its position servo; 0 for an effort drive.
        zero: angle of the model at which the encoder reads zero.
        preload, spring: effort at zero and stiffness of a hypothetical spring, for the replay of
            equivalent effects. No machine here has one.
    """

    damping: float
    friction: float
    armature: float
    kp: float = 0.0
    kv: float = 0.0
    zero: float = 0.0
    preload: float = 0.0
    spring: float = 0.0


@dataclass(frozen=True)
class Machine:
    """Validated model of a machine, or of some of its joints.

    Attributes:
        name: name of the machine or of the kept joints.
        folder: folder of its recordings and model.
        mode: command mode.
        drives: joint -> drive parameters, in the recordings' order.
        held: other joints -> angle at which they are welded, rad.
        mass: body -> mass, kg, if it differs from the file.
        controllers: trial metadata ``controller`` -> kp, for ``twin.yaml``.
        limit: effort limit of the drives, if it differs from the file.
        beside: (effect, joint, values) of ``effects.json``.
        tool: body that carries a payload, and its mass, kg.
        tilt: roll and pitch of the base, rad, in the file's gravity.
        fit, held_out: (recording, first start, last start) of segments, s.
        seconds: duration of a segment, s.
        background: effect that unmodelled physics may be named -> its size, if known, and the
            reason.
    """

    name: str
    folder: str
    mode: str
    drives: Mapping[str, Drive]
    fit: tuple[tuple[str, float, float], ...]
    held_out: tuple[tuple[str, float, float], ...]
    seconds: float
    tool: tuple[str, float]
    held: Mapping[str, float] = field(default_factory=dict)
    mass: Mapping[str, float] = field(default_factory=dict)
    controllers: Mapping[str, float] = field(default_factory=dict)
    limit: float | None = None
    beside: tuple[tuple[str, str | None, Mapping[str, float]], ...] = ()
    tilt: tuple[float, float] = (0.0, 0.0)
    background: Mapping[str, tuple[Mapping[str, float], str]] = field(default_factory=dict)

    @property
    def joints(self) -> tuple[str, ...]:
        """In the recordings' order."""
        return tuple(self.drives)

    def with_drive(self, joint: str, **values: float) -> Machine:
        """Return the machine with changed values of one drive."""
        return replace(self, drives={**self.drives, joint: replace(self.drives[joint], **values)})

    def without(self, effect: str) -> Machine:
        """Return the machine without one effect that acts in addition to the MJCF model."""
        return replace(self, beside=tuple(b for b in self.beside if b[0] != effect))

    def value(self, effect: str, name: str, joint: str | None = None) -> float:
        """Return a value of an effect in ``effects.json``; 0 if it is absent."""
        return sum(v[name] for e, j, v in self.beside if e == effect and joint in (None, j))


SERVO_DELAY = 0.02
"""Command delay of SO-101's bus, s: one sample (fitted 18 to 20 ms)."""
_SO101_HELD = {
    "shoulder_pan": 0.0, "shoulder_lift": 0.25, "elbow_flex": 0.57, "wrist_flex": 0.0,
    "wrist_roll": 0.01, "gripper": 0.5,
}  # fmt: skip
_PAN = Drive(damping=0.80, friction=0.184, armature=0.028, kp=17.7)
_FLEX = Drive(damping=0.42, friction=0.104, armature=0.028, kp=9.52, zero=-0.049)
_ROLL = Drive(damping=0.645, friction=0.142, armature=0.0058, kp=14.1)
_BUS_REST = {"delay": 0.003}
_BUS = {
    "command_delay": (_BUS_REST, "the bus delay is fitted to 2 ms and differs between servos, "
                      "which are read one after another"),
    "sensor_delay": (_BUS_REST, "as command_delay"),
}  # fmt: skip


def _so101(
    name: str, drives: Mapping[str, Drive], fit: tuple[tuple[str, float, float], ...],
    held_out: tuple[tuple[str, float, float], ...], **held: float,
) -> Machine:  # fmt: skip
    others = {j: a for j, a in {**_SO101_HELD, **held}.items() if j not in drives}
    late = tuple(("command_delay", joint, {"delay": SERVO_DELAY}) for joint in drives)
    return Machine(
        name, "so101", "position", drives, fit, held_out, 6.0, ("gripper", 0.087), others,
        beside=late, background=_BUS,
    )  # fmt: skip


MACHINES: Mapping[str, Machine] = {
    m.name: m
    for m in (
        Machine(
            "emps", "emps", "effort", {"slide": Drive(203.5034, 20.3935, 0.0)},
            (("data_emps", 0.0, 19.0),) * 3, (("data_emps_pulses", 0.0, 19.0),), 5.0,
            ("carriage", 95.1089), mass={"carriage": 95.1089},
            beside=(("asymmetric_friction", "slide", {"coulomb": 0.0, "offset": -3.1648}),),
            background={
                "directional_viscous_friction": ({}, "viscous friction differs between the "
                "directions by 36.5 N*s/m (benchmarks/real/record.md)"),
            },
        ),
        Machine(
            "xl330", "xl330", "position", {"pendulum": Drive(0.0598, 0.0105, 0.00167)},
            (("kp100_sin_sin", 0.0, 2.0), ("kp100_sin_time_square", 0.0, 2.0),
             ("kp200_sin_sin", 0.0, 2.0), ("kp200_sin_time_square", 0.0, 2.0),
             ("kp800_sin_sin", 0.0, 2.0), ("kp800_sin_time_square", 0.0, 2.0),
             ("kp800_up_and_down", 0.0, 1.0)),
            (("kp400_sin_sin", 0.0, 2.0), ("kp400_sin_time_square", 0.0, 2.0),
             ("kp400_up_and_down", 0.0, 1.0)),
            4.0, ("arm", 0.49),
            # kp of the data sheet and the limit of 0.832 N*m, times the torque constant's 1.32.
            controllers={"kp100": 0.3155, "kp200": 0.6323, "kp400": 1.2632, "kp800": 2.5265},
            limit=1.098,
            beside=(
                ("torque_rolloff", "pendulum", {"inverse_knee": 1 / 1.08, "back_emf": 0.049}),
                ("motor_load_friction", "pendulum",
                 {"coefficient": 0.18, "stiction_excess": 0.13, "stribeck_velocity": 0.41}),
                ("load_dependent_friction", "pendulum", {"coefficient": 0.10, "of_drive": 0.0}),
                ("encoder_bias", "pendulum", {"bias": -0.0099, "in_loop": 0.0}),
            ),
            background={
                "cogging": ({}, "tooth mesh ripple (real/record.md)"),
                "position_dependent_friction": ({}, "tooth mesh ripple (real/record.md)"),
                "command_delay": ({"delay": 0.0044}, "found without gain 200 "
                                  "(benchmarks/real/record.md)"),
                "sensor_delay": ({"delay": 0.0044}, "as command_delay"),
            },
        ),
        _so101(
            "so101_pan", {"shoulder_pan": _PAN},
            (("single_joint_rotation", 20.0, 85.0), ("ramp_motion", 20.0, 40.0),
             ("sinusoidal_sweep", 22.0, 55.0)),
            (("staircase_motion", 20.0, 30.0), ("single_joint_rotation", 20.0, 85.0)),
        ),
        _so101(
            "so101_flex", {"wrist_flex": _FLEX},
            (("single_joint_wrist_pitch", 2.0, 20.0), ("single_joint_wrist_pitch", 20.0, 34.0),
             ("single_joint_wrist_pitch", 34.0, 49.0)),
            (("single_joint_wrist_pitch", 2.0, 49.0),) * 2,
            shoulder_lift=0.0,
        ),
        _so101(
            "so101_roll", {"wrist_roll": _ROLL},
            (("triangle_wave", 20.0, 38.0), ("triangle_wave", 38.0, 58.0),
             ("wave_motion", 18.0, 24.0)),
            (("triangle_wave", 20.0, 58.0), ("wave_motion", 18.0, 24.0)),
        ),
        _so101(
            "so101_wrist", {"wrist_flex": _FLEX, "wrist_roll": _ROLL},
            (("circular_motion", 18.0, 30.0), ("circular_motion", 30.0, 45.0),
             ("circular_motion", 45.0, 60.0)),
            (("circular_motion", 18.0, 70.0),) * 2,
            shoulder_lift=0.207, elbow_flex=0.594,
        ),
    )
}  # fmt: skip
