"""What an effect is: one piece of physics that a model can have or lack.

An effect states its law, its parameters, where it acts, what it is confused with, and the
experiment that tells them apart. Its hooks change a :class:`World`, the arrays of many simulations
at one step; every array is (rows, joints), so that trials, perturbations and rival hypotheses are
stepped at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.motor_side import Gear, MotorSide
from pytest_twin.trial import CommandMode

Values = Mapping[str, FloatArray]
"""Parameter name -> (rows, joints) values in SI units; neutral where the effect is absent."""

Quantity = Literal[
    "one", "effort", "position", "velocity", "time", "damping", "stiffness", "inertia", "drag",
    "angle", "wavenumber", "effort_per_load", "mass", "length", "acceleration", "temperature",
    "command", "command_rate", "effort_rate",
]  # fmt: skip
Scope = Literal["joint", "robot"]
MODES: tuple[CommandMode, ...] = get_args(CommandMode)
"""What a drive may be commanded."""
PATHS: Mapping[str, str] = {
    "timing": "sensor",
    "sensing": "sensor",
    "actuation": "actuator",
    "friction": "transmission",
    "transmission": "transmission",
    "rigid_body": "rigid body",
    "contact": "contact",
    "environment": "surroundings",
}
"""Family -> where its effects sit, those that change the command aside."""
SMOOTH_STEP = 1e-3
"""Finite difference of a parameter that the motion follows smoothly."""

_UNITS: Mapping[str, tuple[str, str]] = {
    # quantity -> (unit on a hinge, unit on a slide)
    "one": ("1", "1"),
    "effort": ("N*m", "N"),
    "position": ("rad", "m"),
    "velocity": ("rad/s", "m/s"),
    "time": ("s", "s"),
    "damping": ("N*m*s/rad", "N*s/m"),
    "stiffness": ("N*m/rad", "N/m"),
    "inertia": ("kg*m^2", "kg"),
    "drag": ("N*m*s^2/rad^2", "N*s^2/m^2"),
    "angle": ("rad", "rad"),
    "wavenumber": ("1/rad", "1/m"),
    "effort_per_load": ("1", "1"),
    "mass": ("kg", "kg"),
    "length": ("m", "m"),
    "acceleration": ("m/s^2", "m/s^2"),
    "temperature": ("K", "K"),
    "effort_rate": ("N*m/s", "N/s"),
}
_COMMANDED: Mapping[tuple[str, str], tuple[str, str]] = {
    # (quantity, what is commanded) -> (unit on a hinge, unit on a slide)
    ("command", "position"): _UNITS["position"],
    ("command", "velocity"): _UNITS["velocity"],
    ("command", "effort"): _UNITS["effort"],
    ("command_rate", "position"): _UNITS["velocity"],
    ("command_rate", "velocity"): ("rad/s^2", "m/s^2"),
    ("command_rate", "effort"): _UNITS["effort_rate"],
}

REFERENCES: Mapping[str, str] = {
    # of a parameter that is a reciprocal: that of the reported value
    "one": "",
    "twelfth": "a twelfth of the longest recording",
    "effort": "the drive's rms effort",
    "velocity": "the rms speed",
    "position": "the positions' standard deviation",
    "damping": "rms effort / rms speed",
    "stiffness": "rms effort / standard deviation of positions",
    "drag": "rms effort / rms speed^2",
    "inertia": "the inertia that the joint moves",
    "compliance": "rms effort / standard deviation of positions",
    "slowness": "the command's rms rate",
    "effort_slowness": "the rms rate of the effort that the drive's law asks for",
    "inverse_velocity": "the rms speed that is asked for",
    "inverse_effort": "the drive's peak effort",
    "command": "the rms command (a position servo's tracking error)",
    "mass": "the last link's mass, of a flange a fiftieth of the arm's at least",
    "clearance": "1 cm",
    "length": "the way from the last joint to its link's centre of mass, a twentieth of the "
    "arm's length at least, of a flange 0.15 of it",
    "gyration": "the link's radius of gyration about the joint",
}
"""Scale of a joint that bounds and starts are multiples of -> what it is."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of a law.

    Attributes:
        name: as findings report it.
        quantity: what it measures; gives the unit on a hinge or a slide.
        neutral: the value at which the effect is absent, or None where another parameter switches
            the effect off and this one only shapes it.
        lower, upper: physical bounds, in multiples of ``reference``.
        starts: values to start a fit from, in multiples of ``reference``; signed effects are
            tried with the sign that the data ask for.
        reference: the joint's own scale that bounds and starts are multiples of, one of
            ``REFERENCES``.
        reciprocal_of: name and quantity of what is reported in its place: a law that is absent at
            infinity is fitted by its reciprocal.
        step: finite difference of a fit's Jacobian, in multiples of ``reference``; wide where the
            motion follows the parameter in small leaps, as impacts between steps make it.
        choice: whether it is one of its starts, never between: no fit moves it. A wavenumber may be
            any whole one within its bounds.
        reach: how far a fit tries it beside its slope, in multiples of ``reference``: where an edge
            belongs in time, the slope says no further than the drive takes to answer.
        under: name of a choice and its values in which the law has this parameter; in others it is
            neutral. None where the law always has it.
    """

    name: str
    quantity: Quantity
    neutral: float | None
    lower: float
    upper: float
    starts: tuple[float, ...]
    reference: str = "one"
    reciprocal_of: tuple[str, Quantity] | None = None
    step: float = SMOOTH_STEP
    choice: bool = False
    reach: float | None = None
    under: tuple[str, tuple[float, ...]] | None = None

    @property
    def absent(self) -> float:
        """What stands for it where the law is not there, or its form lacks it; in multiples of
        ``reference``.
        """
        if self.neutral is not None:
            return self.neutral
        return self.starts[0] if self.under is None else 0.0

    @property
    def reported_name(self) -> str:
        """As findings name it."""
        return self.name if self.reciprocal_of is None else self.reciprocal_of[0]

    def reported(self, value: float) -> float:
        """The value that goes with :attr:`reported_name`: of a reciprocal, infinite at zero."""
        if self.reciprocal_of is None:
            return value
        return 1.0 / value if value else float("inf")

    def unit(self, joint_type: str, servo: str = "position") -> str:
        """SI unit of the reported value on a ``hinge`` or a ``slide``.

        Args:
            servo: what is commanded: a ``command`` quantity is in its unit.
        """
        quantity = self.quantity if self.reciprocal_of is None else self.reciprocal_of[1]
        commanded = servo if servo in MODES else MODES[0]
        units = _COMMANDED.get((quantity, commanded)) or _UNITS[quantity]
        return units[1 if joint_type == "slide" else 0]


@dataclass(slots=True)
class World:
    """Many simulations at one step. Arrays are (rows, joints) unless said otherwise.

    The drive's law is ``gain setpoint - stiffness position - damping velocity + offset`` within
    ``lower`` and ``upper``; for a position servo ``gain`` is its stiffness, for a velocity servo
    its damping, for an effort drive 1 (MuJoCo's affine actuators).

    Attributes:
        time: (rows,) s since the start of the trial.
        timestep: s.
        position, velocity: of the joints, rad and rad/s or m and m/s.
        setpoint: command to the drive as it stands after every earlier hook.
        gain, stiffness, damping, offset: of the drive's law, SI units at the joint.
        lower, upper: bounds of the drive's effort, N*m or N.
        servo: (joints,) ``position``, ``velocity``, ``effort``, or ``none`` without a drive.
        delivered: effort that reaches the joint; hooks of the drive change it.
        friction_level: dry friction that the solver may use up to, N*m or N.
        applied: added generalized force, N*m or N.
        load: gravity and Coriolis effort that the drive carries, N*m or N.
        motor_armature, motor_damping, motor_constant: of the motor's side, where a gear gives:
            there the link has no armature, damping, dry friction or drive of its own. The last is
            effort that always acts on the motor, N*m or N.
        link_inertia: least that a link puts against its gear, kg*m^2 or kg.
        coldness: (rows,) of the trial: 1 in the coldest, 0 in the warmest.
        motor: its side of the gears; None where all are rigid.
        state: memory of effects between steps, by effect id.
    """

    time: FloatArray
    timestep: float
    position: FloatArray
    velocity: FloatArray
    setpoint: FloatArray
    gain: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    offset: FloatArray
    lower: FloatArray
    upper: FloatArray
    servo: NDArray[np.str_]
    delivered: FloatArray
    friction_level: FloatArray
    applied: FloatArray
    load: FloatArray
    motor_armature: FloatArray
    motor_damping: FloatArray
    motor_constant: FloatArray
    link_inertia: FloatArray
    coldness: FloatArray = field(default_factory=lambda: np.ones(1))
    motor: MotorSide | None = None
    state: dict[str, Any] = field(default_factory=dict)

    @property
    def motor_position(self) -> FloatArray:
        """Of the motors, seen from the links."""
        return self.position if self.motor is None else self.motor.angle

    @property
    def motor_velocity(self) -> FloatArray:
        """Of the motors, seen from the links."""
        return self.velocity if self.motor is None else self.motor.speed

    def push_motor(self, effort: FloatArray) -> None:
        """Add effort on the motor's side of the gears, N*m or N at the joint."""
        if self.motor is None:
            self.applied += effort
        else:
            self.motor.applied += effort

    def drag_motor(self, damping: FloatArray) -> None:
        """Resist the motors' speed in this step, N*m s/rad or N s/m at the joint."""
        if self.motor is None:
            self.applied -= damping * self.velocity
        else:
            self.motor.drag += damping

    def asked(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """What the drive's law asks for at a state of its motor, (rows, joints), without bounds."""
        return (
            self.gain * self.setpoint
            - self.stiffness * position
            - self.damping * velocity
            + self.offset
        )


class Effect:
    """One effect. Subclasses state the class attributes and override the hooks that they need.

    ``fields`` and ``gains`` run once before the first step; ``command``, ``servo``, ``drive``,
    ``friction`` and ``force`` at every step, in this order (an effect without them costs nothing
    between steps); ``gear`` once before the first of them; ``command_delay``, ``sample_time`` and
    ``sense`` on whole trajectories. A hook must leave the world as it found it where every
    parameter is neutral.

    Class attributes:
        id: name in the contract's table.
        family: ``timing``, ``sensing``, ``actuation``, ``friction``, ``transmission``,
            ``rigid_body``, ``contact`` or ``environment``.
        law: the formula in words and symbols.
        source: where it is from.
        parameters: at least one.
        scope: ``joint``, or ``robot`` where it is the whole robot's.
        confused_with: effect id -> the experiment that tells the two apart.
        has_in_it: laws that this one comes to at some of its parameters.
        modes: command modes under which it can act.
        remembers: whether a hook keeps a state between steps.
        remembers_path: whether what its ``force`` keeps fades with the way that the joint goes, not
            with time.
        reads_other_joints: whether a hook of a joint reads what another joint's drive does.
        asks_temperature: whether a hook reads how cold a trial is.
        reads_drive: whether ``friction`` reads what the drive delivers.
        of_position: whether its effort follows from the joint's position and nothing else.
        over_the_turn: whether it is dry friction whose level varies with the joint's position.
        of_every_drive: whether every motor behind a gear has it, more or less.
        reads_after: of a sensor's laws those with a smaller number act before it, on what is true:
            a wheel's errors are counted, counts are scaled, and the zero is set in what comes out.
    """

    id: ClassVar[str]
    family: ClassVar[str]
    law: ClassVar[str]
    source: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    scope: ClassVar[Scope] = "joint"
    confused_with: ClassVar[Mapping[str, str]] = {}
    has_in_it: ClassVar[frozenset[str]] = frozenset()
    modes: ClassVar[tuple[str, ...]] = MODES
    remembers: ClassVar[bool] = False
    remembers_path: ClassVar[bool] = False
    reads_other_joints: ClassVar[bool] = False
    asks_temperature: ClassVar[bool] = False
    reads_drive: ClassVar[bool] = False
    of_position: ClassVar[bool] = False
    over_the_turn: ClassVar[bool] = False
    of_every_drive: ClassVar[bool] = False
    reads_after: ClassVar[int] = 0

    @property
    def path(self) -> str:
        """Where between command and reading it sits: ``command``, ``actuator``, ``transmission``,
        ``rigid body``, ``sensor``, ``contact`` or ``surroundings``.
        """
        if self.overrides("command_delay", "command") and not self.overrides("drive"):
            return "command"
        return PATHS[self.family]

    def overrides(self, *hooks: str) -> bool:
        """Whether any of these hooks does anything."""
        return any(getattr(type(self), h) is not getattr(Effect, h) for h in hooks)

    def has(self, parameters: FloatArray) -> NDArray[np.bool_]:
        """(parameters,) which of them the law has in the form that these values choose."""
        chosen = dict(zip((p.name for p in self.parameters), parameters, strict=True))
        return np.array(
            [p.under is None or chosen[p.under[0]] in p.under[1] for p in self.parameters]
        )

    @property
    def has_forms(self) -> bool:
        """Whether some of its forms have parameters that others lack."""
        return any(p.under is not None for p in self.parameters)

    def special_cases(self, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        """Laws with fewer parameters that this one comes to: effect id -> its parameters, SI."""
        return {}

    def holds(self, effect: str) -> Mapping[str, str]:
        """Which parameters of this law take up another's; what is not among them is lost."""
        return {}

    def with_other(
        self, own: Mapping[str, float], effect: str, other: Mapping[str, float]
    ) -> Mapping[str, float]:
        """What changes of its parameters where this law does what another did beside it as well;
        nothing where it cannot.

        Args:
            own: its parameters, in multiples of references.
            effect: the other.
            other: the other's parameters, in multiples of the same references.
        """
        return {mine: own[mine] + other[theirs] for theirs, mine in self.holds(effect).items()}

    def coordinates(self, parameters: FloatArray) -> FloatArray:
        """Numbers in which the motion bends less than in the parameters: a fit steps in them.

        Both are (parameters,), in multiples of references.
        """
        return parameters

    def from_coordinates(self, coordinates: FloatArray) -> FloatArray:
        """The inverse of ``coordinates``."""
        return coordinates

    def command_delay(self, values: Values) -> FloatArray | None:
        """Latency of the command, (rows, joints) s."""
        return None

    def sample_time(self, time: FloatArray, values: Values) -> FloatArray:
        """When a sample stamped (rows, samples, joints) ``time`` was really taken, s."""
        return time

    def fields(self, fields: ModelFields, values: Values) -> None:
        """Change model fields that hold for a whole simulation."""

    def gains(self, world: World, values: Values) -> None:
        """Change the drive's gains, offset and bounds for a whole simulation."""

    def command(self, world: World, values: Values) -> None:
        """Change ``world.setpoint``: what reaches the drive."""

    def follow_commands(
        self, world: World, values: Values, commands: Iterable[tuple[FloatArray, FloatArray]]
    ) -> None:
        """Let what remembers commands alone live through all that were held before a window begins.

        Args:
            world: rows at the start of their windows.
            values: as in every hook.
            commands: one after the other (rows, joints) rad, m, per s, N*m or N, and for how long
                it was held, (rows, joints) s, 0 where it never came. Worked out as they are taken.
        """

    def servo(self, world: World, values: Values) -> None:
        """Change the setpoint that the drive's law sees, and its bounds."""

    def drive(self, world: World, values: Values) -> None:
        """Change ``world.delivered``: what the drive gives of what its law asks for."""

    def friction(self, world: World, values: Values) -> None:
        """Change ``world.friction_level``."""

    def force(self, world: World, values: Values) -> None:
        """Add to ``world.applied``, or push the motor."""

    def separates(self, values: Values) -> NDArray[np.bool_] | None:
        """(rows, joints) where motor and link move apart, or None."""
        return None

    def gear(self, gear: Gear, world: World, values: Values) -> None:
        """Change what stands between motor and link; once, before the first step."""

    def sense(
        self, time: FloatArray, position: FloatArray, velocity: FloatArray, values: Values
    ) -> tuple[FloatArray, FloatArray]:
        """What sensors read of (rows, samples, joints) trajectories."""
        return position, velocity

    def unsense(
        self, position: FloatArray, velocity: FloatArray, values: Values
    ) -> tuple[FloatArray, FloatArray]:
        """The (rows, joints) state behind a measured one: the inverse of ``sense``."""
        return position, velocity

    def sense_effort(self, effort: FloatArray, values: Values) -> FloatArray:
        """What an effort sensor reads of (rows, samples, joints) efforts."""
        return effort


def moving_apart(
    effects: Sequence[tuple[Effect, Values]], shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    """(rows, joints) where a gear lets motor and link move apart."""
    apart = np.zeros(shape, dtype=bool)
    for effect, v in effects:
        given = effect.separates(v)
        if given is not None:
            apart |= given
    return apart


@dataclass(slots=True)
class ModelFields:
    """Per-row model fields that effects may change, (rows, joints) unless said otherwise.

    Attributes:
        damping: passive viscous damping.
        armature: reflected inertia of the drive, kg*m^2 or kg.
        friction: dry friction of the model, N*m or N.
        constant_force: generalized force that is always there, N*m or N.
        motor_force: the same, on the motor's side of a gear that gives.
        stiffness: passive spring about the model's own rest, N*m/rad or N/m.
        gravity: (rows, 3) m/s^2, world frame.
        added_mass: (rows, joints) kg, on the link that the joint moves.
        added_at: (rows, joints, 3) where, m from the joint: along the link's own direction (from
            the joint to the link's centre of mass; of a flange, along the joint's axis), the way
            that the joint turns it there, and across both.
        mass_scale, inertia_scale: (rows, joints) factors on that link's mass, and on its inertia
            about its centre of mass.
        center_radial, center_tangential: (rows, joints) m by which that centre is moved away from
            the joint's axis, and the way that the joint turns it.
        contact_offset: (rows,) or (1,) m, of the surfaces that the robot meets.
        contact_stiffness, contact_damping: the same, relative errors.
        contact_friction: the same, added to the sliding friction coefficient.
    """

    damping: FloatArray
    armature: FloatArray
    friction: FloatArray
    constant_force: FloatArray
    motor_force: FloatArray
    stiffness: FloatArray
    gravity: FloatArray
    added_mass: FloatArray
    added_at: FloatArray
    mass_scale: FloatArray
    inertia_scale: FloatArray
    center_radial: FloatArray
    center_tangential: FloatArray
    contact_offset: FloatArray = field(default_factory=lambda: np.zeros(1))
    contact_stiffness: FloatArray = field(default_factory=lambda: np.zeros(1))
    contact_damping: FloatArray = field(default_factory=lambda: np.zeros(1))
    contact_friction: FloatArray = field(default_factory=lambda: np.zeros(1))

    @classmethod
    def neutral(cls, gravity: FloatArray, joints: int) -> ModelFields:
        """Fields that change nothing, under (rows, 3) gravity."""
        none = (len(gravity), joints)
        return cls(
            damping=np.zeros(none),
            armature=np.zeros(none),
            friction=np.zeros(none),
            constant_force=np.zeros(none),
            motor_force=np.zeros(none),
            stiffness=np.zeros(none),
            gravity=gravity,
            added_mass=np.zeros(none),
            added_at=np.zeros((*none, 3)),
            mass_scale=np.ones(none),
            inertia_scale=np.ones(none),
            center_radial=np.zeros(none),
            center_tangential=np.zeros(none),
        )

    @property
    def center_moves(self) -> NDArray[np.bool_]:
        """(rows, joints) whose links have their centre of mass elsewhere."""
        return np.asarray((self.center_radial != 0.0) | (self.center_tangential != 0.0))

    @property
    def changes_links(self) -> bool:
        """Whether some link's mass, centre or inertia is another one."""
        scaled = (self.mass_scale != 1.0) | (self.inertia_scale != 1.0)
        return bool((scaled | self.center_moves | (self.added_mass != 0.0)).any())

    def split_force(self, apart: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
        """Constant forces on links and on motors, each motor being its link unless ``apart``."""
        link: FloatArray = self.constant_force + np.where(apart, 0.0, self.motor_force)
        motor: FloatArray = np.where(apart, self.motor_force, 0.0)
        return link, motor
