"""The interface of an effect: one physical effect that a model can have or lack.

An effect states its law, its parameters and its scope. It also names the effects that it is
confused with, and the experiment that separates them. Its hooks change a :class:`World`: the state
of many simulations at one time step. Every array is (rows, joints), one row per simulation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.fast_clip import fast_clip
from pytest_twin.effects.motor_side import Gear, MotorSide
from pytest_twin.effects.proposal import JointFit, Start, sizes_up_to_bound, starting_sizes
from pytest_twin.trial import CommandMode

if TYPE_CHECKING:
    import mujoco

    from pytest_twin.effects.layout import Layout

Values = Mapping[str, FloatArray]
"""Parameter name -> (rows, joints) values in SI units; the neutral value where it is absent."""

Quantity = Literal[
    "one", "effort", "position", "velocity", "time", "damping", "stiffness", "inertia", "drag",
    "angle", "wavenumber", "effort_per_load", "mass", "length", "acceleration", "temperature",
    "command", "command_rate", "effort_rate",
]  # fmt: skip
Scope = Literal["joint", "robot"]
MODES: tuple[CommandMode, ...] = get_args(CommandMode)
"""What a drive may be commanded."""
SIGNAL_PATHS: Mapping[str, str] = {
    "timing": "sensor",
    "sensing": "sensor",
    "actuation": "actuator",
    "friction": "transmission",
    "transmission": "transmission",
    "rigid_body": "rigid body",
    "contact": "contact",
    "environment": "surroundings",
}
"""Family -> part of the signal path of its effects; effects on the command are in ``command``."""
StageOfEffect = Literal[
    "delay", "encoder", "gravity", "inertia", "friction", "drive", "closed_loop", "contact", "none",
]  # fmt: skip
"""Stages of an identification that fit effects; ``none`` for an effect that none fits."""
JOINT_FIELDS = ("armature", "damping", "frictionloss")
"""Attributes of an MJCF joint to which the one parameter of an effect may be added."""
SMOOTH_STEP = 1e-3
"""Finite-difference step for a parameter on which the motion depends smoothly."""

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
_COMMAND_UNITS: Mapping[tuple[str, str], tuple[str, str]] = {
    # (quantity, what is commanded) -> (unit on a hinge, unit on a slide)
    ("command", "position"): _UNITS["position"],
    ("command", "velocity"): _UNITS["velocity"],
    ("command", "effort"): _UNITS["effort"],
    ("command_rate", "position"): _UNITS["velocity"],
    ("command_rate", "velocity"): ("rad/s^2", "m/s^2"),
    ("command_rate", "effort"): _UNITS["effort_rate"],
}

REFERENCES: Mapping[str, str] = {
    # For a parameter that is fitted as a reciprocal: the scale of the reported value.
    "one": "",
    "twelfth": "a twelfth of the longest recording",
    "effort": "the drive's RMS effort",
    "velocity": "the RMS speed",
    "position": "the standard deviation of the position",
    "damping": "RMS effort / RMS speed",
    "stiffness": "RMS effort / standard deviation of the position",
    "drag": "RMS effort / RMS speed^2",
    "inertia": "the inertia about the joint",
    "compliance": "RMS effort / standard deviation of the position",
    "slowness": "the RMS rate of the command",
    "effort_slowness": "the RMS rate of the effort that the control law requests",
    "inverse_velocity": "the RMS commanded speed",
    "inverse_effort": "the drive's peak effort",
    "command": "the RMS command (for a position servo: the RMS tracking error)",
    "mass": "the last link's mass (for a flange: at least 1/50 of the arm's mass)",
    "clearance": "1 cm",
    "length": "the distance from the last joint to its link's centre of mass (at least 1/20 of the "
    "arm's length; for a flange at least 0.15 of it)",
    "gyration": "the link's radius of gyration about the joint",
}
"""Reference scale of a joint -> its definition; bounds and starting values are multiples of it."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of a law.

    Attributes:
        name: key in ``diagnosis.json``.
        quantity: physical quantity; gives the unit on a hinge or a slide.
        neutral: value at which the effect is absent; None where another parameter switches the
            effect off and this one only shapes it.
        lower, upper: physical bounds, in multiples of ``reference``.
        starts: starting values of a fit, in multiples of ``reference``; a signed effect starts
            with the sign that the data require.
        reference: scale of the joint, one of ``REFERENCES``.
        reciprocal_of: name and quantity of the reported value where the fit uses its reciprocal,
            because the law is absent at infinity.
        step: finite-difference step of the Jacobian, in multiples of ``reference``. It is wide
            where the motion depends on the parameter in small jumps, as impacts cause.
        choice: whether the parameter only takes the values in ``starts``; no fit moves it. A
            wavenumber may be any integer within its bounds.
        reach: how far a fit also searches beyond the local slope, in multiples of ``reference``.
            Start and end times need it: their slope is valid only over the drive's response time.
        under: name of a choice and its values for which the law has this parameter; None where
            the law always has it. Otherwise the parameter is neutral.
        meaning: what the reported value is, as a noun phrase; the name where it is empty.
        relation: how the reported value relates to the model's own: ``added`` to it, ``relative``
            to it (0.1: 10 % above), or empty for a value by itself.
        choices: one phrase for each value in ``starts`` of a choice.
        part_of: quantity of the joint that contains it, so that it is never larger; ``damping``
            for back-EMF, which models hold as passive damping.
        difference_of: parameter of the law whose mean over both directions of motion it turns into
            two values: half the difference between them.
        sums_with: parameter of the law to which it is added; the upper bound of that one, in SI
            units, holds for the sum.
        usual: standard deviation of the values that parts of this kind have, in multiples of
            ``reference``, around ``neutral``; None where any value within the bounds is as likely.
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
    meaning: str = ""
    relation: Literal["", "added", "relative"] = ""
    choices: tuple[str, ...] = ()
    part_of: Literal["", "damping"] = ""
    difference_of: str = ""
    sums_with: str = ""
    usual: float | None = None

    @property
    def absent_value(self) -> float:
        """Value where the law is absent or its form lacks the parameter, in multiples of
        ``reference``.
        """
        if self.neutral is not None:
            return self.neutral
        return self.starts[0] if self.under is None else 0.0

    def combined(self, first: FloatArray | float, second: FloatArray | float) -> Any:
        """Value of two of these amplitudes together, SI units; the factors of relative errors
        multiply.
        """
        assert self.neutral is not None
        if self.relation == "relative":
            return (1.0 + first) * (1.0 + second) - 1.0
        return first + second - self.neutral

    @property
    def reported_name(self) -> str:
        """Key of the reported value in ``diagnosis.json``."""
        return self.name if self.reciprocal_of is None else self.reciprocal_of[0]

    def reported(self, value: float) -> float:
        """The value for :attr:`reported_name`; the reciprocal of zero is infinity."""
        if self.reciprocal_of is None:
            return value
        return 1.0 / value if value else float("inf")

    def unit(self, joint_type: str, servo: str = "position") -> str:
        """SI unit of the reported value on a ``hinge`` or a ``slide``.

        Args:
            servo: command mode; a ``command`` quantity has its unit.
        """
        quantity = self.quantity if self.reciprocal_of is None else self.reciprocal_of[1]
        commanded = servo if servo in MODES else MODES[0]
        units = _COMMAND_UNITS.get((quantity, commanded)) or _UNITS[quantity]
        return units[1 if joint_type == "slide" else 0]

    def fitted_unit(self, joint_type: str, servo: str = "position") -> str:
        """SI unit of the value that a fit estimates, which may be the reciprocal of the reported
        one.

        Args:
            joint_type, servo: as for :meth:`unit`.
        """
        unit = self.unit(joint_type, servo)
        return unit if self.reciprocal_of is None else reciprocal_unit(unit)


def reciprocal_unit(unit: str) -> str:
    """Unit of the reciprocal of a value: ``s/rad`` of ``rad/s``, ``1/(N*m)`` of ``N*m``."""
    numerator, _, denominator = unit.partition("/")
    divisor = f"({numerator})" if "*" in numerator else numerator
    return f"{denominator or 1}/{divisor}"


def si_unit(quantity: Quantity, slide: bool) -> str:
    """SI unit of a quantity on a slide or a hinge."""
    return _UNITS[quantity][1 if slide else 0]


@dataclass(slots=True)
class World:
    """State of many simulations at one time step; arrays are (rows, joints) unless noted.

    The control law is ``gain setpoint - stiffness position - damping velocity + offset``, limited
    to ``lower`` and ``upper``. ``gain`` is the stiffness of a position servo, the damping of a
    velocity servo, 1 for an effort drive (MuJoCo's affine actuators).

    Attributes:
        time: (rows,) s since the start of the trial.
        timestep: s.
        position, velocity: joint state, rad and rad/s or m and m/s.
        setpoint: command to the drive, after all earlier hooks.
        least_setpoint, greatest_setpoint: range of commands that the drive accepts; ``servo`` hooks
            may leave it.
        gain, stiffness, damping, offset: coefficients of the control law, SI units at the joint.
        lower, upper: limits of the drive's effort, N*m or N.
        servo: (joints,) ``position``, ``velocity``, ``effort``, or ``none`` without a drive.
        delivered: effort that reaches the joint; the ``drive`` hooks change it.
        friction_level: largest dry friction that the solver may apply, N*m or N.
        applied: added generalized force, N*m or N.
        load: gravity and Coriolis effort that the drive carries, N*m or N.
        motor_armature, motor_damping, motor_constant_effort: motor side of an elastic transmission,
            which then holds the joint's armature, damping, dry friction and drive. The last is a
            constant effort on the motor, N*m or N.
        link_inertia: smallest inertia of the link as the transmission sees it, kg*m^2 or kg.
        cold_fraction: (rows,) normalized temperature of the trial: 1 in the coldest, 0 in the
            warmest.
        motor: state of the motor sides; None where all transmissions are rigid.
        state: memory of effects between steps, by effect id.
        has_setpoint_range: whether any command has a limited range; None until the first step.
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
    motor_constant_effort: FloatArray
    link_inertia: FloatArray
    least_setpoint: FloatArray = field(default_factory=lambda: np.full((1, 1), -np.inf))
    greatest_setpoint: FloatArray = field(default_factory=lambda: np.full((1, 1), np.inf))
    cold_fraction: FloatArray = field(default_factory=lambda: np.ones(1))
    motor: MotorSide | None = None
    state: dict[str, Any] = field(default_factory=dict)
    has_setpoint_range: bool | None = None

    @property
    def motor_position(self) -> FloatArray:
        """Motor positions, converted to the joint side."""
        return self.position if self.motor is None else self.motor.position

    @property
    def motor_velocity(self) -> FloatArray:
        """Motor velocities, converted to the joint side."""
        return self.velocity if self.motor is None else self.motor.velocity

    def limit_setpoint(self) -> None:
        """Limit the commands to the range that the drives accept."""
        low, high = self.least_setpoint, self.greatest_setpoint
        if self.has_setpoint_range is None:
            self.has_setpoint_range = bool((low > -np.inf).any() or (high < np.inf).any())
        if self.has_setpoint_range:
            self.setpoint = fast_clip(self.setpoint, low, high)

    def push_motor(self, effort: FloatArray) -> None:
        """Add effort on the motor side of the transmission, N*m or N at the joint."""
        if self.motor is None:
            self.applied += effort
        else:
            self.motor.applied += effort

    def drag_motor(self, damping: FloatArray) -> None:
        """Add viscous damping on the motor side in this step, N*m*s/rad or N*s/m at the joint."""
        if self.motor is None:
            self.applied -= damping * self.velocity
        else:
            self.motor.damping += damping

    def control_effort(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """(rows, joints) effort of the control law before its limits, N*m or N.

        Args:
            position, velocity: (rows, joints) state of the motors, converted to the joint side.
        """
        effort = self.gain * self.setpoint
        effort -= self.stiffness * position
        effort -= self.damping * velocity
        effort += self.offset
        return effort


@dataclass(frozen=True, slots=True)
class RegressorColumn:
    """Column of the inverse dynamics of one joint.

    Attributes:
        effort: (n,) effort of the drive per unit of the parameter, N*m or N.
        by_position, by_velocity, by_acceleration: (n,) its slopes; 0 where it does not depend on
            them. A direction of motion counts as constant.
    """

    effort: FloatArray
    by_position: FloatArray | float = 0.0
    by_velocity: FloatArray | float = 0.0
    by_acceleration: FloatArray | float = 0.0


@dataclass(frozen=True, slots=True)
class PoseShift:
    """Shift of a joint's position by one parameter.

    Attributes:
        slope: change of the position per unit of the parameter and of the quantity ``by``.
        by: quantity that the shift is proportional to: the joint's ``velocity``, its ``load``, the
            ``side`` of the gap on which the load presses the teeth (1 or -1), or ``one``.
    """

    slope: float
    by: Literal["velocity", "load", "side", "one"]


class Effect:
    """One effect. Subclasses state the class attributes and override the hooks that they need.

    ``fields`` and ``gains`` run once before the first step, then ``gear``. ``command``, ``servo``,
    ``drive``, ``friction`` and ``force`` run at every step, in this order. ``command_latency``,
    ``sample_time`` and ``sense`` run on whole trajectories. A hook must change nothing where every
    parameter is neutral. A hook that is not overridden costs no time.

    The search of a diagnosis depends only on an effect's traits, not on its id. Traits are class
    attributes too.

    Class attributes:
        id: name in ``diagnosis.json``; equals the entry point's.
        family: ``timing``, ``sensing``, ``actuation``, ``friction``, ``transmission``,
            ``rigid_body``, ``contact`` or ``environment``.
        law: the equation; ``"; "`` separates lines.
        source: textbook or article of the equation.
        parameters: at least one.
        scope: ``joint``, or ``robot`` for an effect of the whole robot.
        confused_with: effect id -> the experiment that separates the two.
        generalizes: ids of effects that are special cases of this one.
        modes: command modes under which it can act.
        remembers: whether a hook keeps a state between steps.
        remembers_path: whether the state of ``force`` fades with the distance travelled, not with
            time.
        reads_other_joints: whether a hook of a joint reads another joint's drive.
        reads_delivered_effort: whether ``friction`` reads the effort that the drive delivers.
        reads_load: whether ``servo`` reads the load of the joint.
        hook_order: order in which effects run in each hook, smaller first. The encoder's
            eccentricity comes before its scale, and that before its zero.

    Traits:
        is_limit: whether it limits what the drive does. Recordings then determine the size only
            within a narrow range, so the search also tries many sizes between and beyond the
            ``starts`` of a parameter, which increase.
        periodic: whether the law repeats over the turn of a hinge; it does not apply to a slide.
        needs_effort_sensor: whether only readings of effort can show it.
        needs_temperature: whether a hook reads the temperature of a trial.
        nearly_linear: whether the change of the motion is nearly proportional to the parameters.
        dry_friction_level: name of the parameter that is a constant level of dry friction; None
            without one.
        candidate: whether the search proposes it.
        stage: stage of an identification that reports it. Those of ``closed_loop`` are candidates
            once a search with the others has ended and a residual remains.
        basic_modes: command modes of a joint under which every robot has it, such as friction.
        mjcf_field: attribute of an MJCF joint to which its one parameter is added, one of
            ``JOINT_FIELDS``; empty without one.
        regressor_symbol: symbol of its one parameter in the literature, where the effort of the
            drive is linear in it. Identification from measured effort then estimates it, and
            excitation is designed for it; :meth:`regressor_column` is its column.
    """

    id: ClassVar[str]
    family: ClassVar[str]
    law: ClassVar[str]
    source: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    scope: ClassVar[Scope] = "joint"
    confused_with: ClassVar[Mapping[str, str]] = {}
    generalizes: ClassVar[frozenset[str]] = frozenset()
    modes: ClassVar[tuple[str, ...]] = MODES
    remembers: ClassVar[bool] = False
    remembers_path: ClassVar[bool] = False
    reads_other_joints: ClassVar[bool] = False
    reads_delivered_effort: ClassVar[bool] = False
    reads_load: ClassVar[bool] = False
    hook_order: ClassVar[int] = 0
    is_limit: ClassVar[bool] = False
    periodic: ClassVar[bool] = False
    needs_effort_sensor: ClassVar[bool] = False
    needs_temperature: ClassVar[bool] = False
    nearly_linear: ClassVar[bool] = False
    dry_friction_level: ClassVar[str | None] = None
    candidate: ClassVar[bool] = True
    stage: ClassVar[StageOfEffect] = "closed_loop"
    basic_modes: ClassVar[tuple[str, ...]] = ()
    mjcf_field: ClassVar[str] = ""
    regressor_symbol: ClassVar[str] = ""

    @property
    def path(self) -> str:
        """Part of the signal path: ``command``, ``actuator``, ``transmission``, ``rigid body``,
        ``sensor``, ``contact`` or ``surroundings``.
        """
        if self.overrides("command_latency", "command") and not self.overrides("servo", "drive"):
            return "command"
        return SIGNAL_PATHS[self.family]

    @property
    def is_elastic_transmission(self) -> bool:
        """Whether it lets the motor move relative to the link."""
        return self.overrides("separates")

    def overrides(self, *hooks: str) -> bool:
        """Whether the effect overrides any of these hooks."""
        return any(getattr(type(self), h) is not getattr(Effect, h) for h in hooks)

    def has(self, parameters: FloatArray) -> NDArray[np.bool_]:
        """(parameters,) whether the law has each parameter, in the form that the values select."""
        chosen = dict(zip((p.name for p in self.parameters), parameters, strict=True))
        return np.array(
            [p.under is None or chosen[p.under[0]] in p.under[1] for p in self.parameters]
        )

    @property
    def has_forms(self) -> bool:
        """Whether some of its forms have parameters that others lack."""
        return any(p.under is not None for p in self.parameters)

    @property
    def shows_in_motion_alone(self) -> bool:
        """Whether motion shows it without effort readings and without contact."""
        return not self.needs_effort_sensor and self.family != "contact"

    def regressor_column(
        self, position: FloatArray, velocity: FloatArray, acceleration: FloatArray
    ) -> RegressorColumn:
        """Effort of the drive per unit of its parameter, and its slopes along the motion.

        Args:
            position, velocity, acceleration: (n,) of the joint.
        """
        raise NotImplementedError

    def pose_shift(
        self, parameter: str, value: float, unit: str, servo_stiffness: float | None
    ) -> PoseShift | str | None:
        """Shift of the joint's position by one of its parameters while the joint is held.

        Returns:
            The shift; a reason why there is none; or None if the effect shifts no pose, or none
            that a rule states.

        Args:
            parameter: name; empty for the only one that a fit changes.
            value, unit: reported value, SI.
            servo_stiffness: stiffness of the joint's position servo without the effect, N*m/rad or
                N/m; None without a servo.
        """
        return None

    def acts_on_servo(self, stiffness: float, damping: float) -> NDArray[np.bool_]:
        """(parameters,) whether each changes a drive with these gains; one without damping has none
        to change.

        Args:
            stiffness: of the position servo, N*m/rad or N/m.
            damping: of the servo, N*m*s/rad or N*s/m.
        """
        return np.ones(len(self.parameters), dtype=bool)

    def special_cases(self, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        """Special cases with fewer parameters: effect id -> its parameters, SI."""
        return {}

    def equivalents(
        self, values: Mapping[str, float], layout: Layout, model: mujoco.MjModel, joint: int
    ) -> Mapping[str, Mapping[str, float]]:
        """Other effects with nearly the same motion: effect id -> its parameters, SI.

        Args:
            layout: indices of the model's joints.
            joint: column of the joint that it acts on; -1 for the whole robot.
        """
        return {}

    def propose(self, at: JointFit) -> Iterable[Start]:
        """Starts that the search simulates, because no slope at the present fit leads to them.

        By default limits and elastic transmissions that the fit lacks propose all their starting
        sizes, and limits also sizes up to their bound: a limit is discontinuous, and an elastic
        transmission feeds the motion back. Other effects propose nothing; the search linearizes
        them. An effect that the fit contains may propose changes of itself and of another effect
        whose influence cancels to first order.

        Args:
            at: the present fit at one joint.
        """
        if at.present is None and (self.is_limit or self.is_elastic_transmission):
            for size in (*starting_sizes(self), *sizes_up_to_bound(self)):
                yield Start(size)

    def holds(self, effect: str) -> Mapping[str, str]:
        """Another effect's parameter -> the parameter of this one that can represent it."""
        return {}

    def with_other(
        self, own: Mapping[str, float], effect: str, other: Mapping[str, float]
    ) -> Mapping[str, float]:
        """Changed parameters with which this law also represents another effect.

        Empty if it cannot represent the other effect.

        Args:
            own: parameters of this effect, in multiples of references.
            effect: id of the other effect.
            other: the other's parameters, in multiples of the same references.
        """
        return {here: own[here] + other[there] for there, here in self.holds(effect).items()}

    def coordinates(self, parameters: FloatArray) -> FloatArray:
        """Coordinates in which the motion is closer to linear; a fit steps in them.

        Both are (parameters,), in multiples of references.
        """
        return parameters

    def from_coordinates(self, coordinates: FloatArray) -> FloatArray:
        """The inverse of ``coordinates``."""
        return coordinates

    def command_latency(self, values: Values) -> FloatArray | None:
        """Latency of the command, (rows, joints) s."""
        return None

    def sample_time(self, time: FloatArray, values: Values) -> FloatArray:
        """True times of samples stamped (rows, samples, joints) ``time``, s."""
        return time

    def fields(self, fields: ModelFields, values: Values) -> None:
        """Change model fields that are constant over a simulation."""

    def gains(self, world: World, values: Values) -> None:
        """Change the drive's gains, offset and limits, constant over a simulation."""

    def command(self, world: World, values: Values) -> None:
        """Change ``world.setpoint``, the command that reaches the drive."""

    def follow_commands(
        self, world: World, values: Values, commands: Iterable[tuple[FloatArray, FloatArray]]
    ) -> None:
        """Bring a memory of past commands up to date before a window begins.

        Args:
            world: rows at the start of their windows.
            values: as in every hook.
            commands: pairs of a (rows, joints) command and its (rows, joints) duration in s, in
                order; the duration is 0 where the command was never sent.
        """

    def servo(self, world: World, values: Values) -> None:
        """Change the setpoint in the control law, and the drive's limits."""

    def drive(self, world: World, values: Values) -> None:
        """Change ``world.delivered``, the effort that the drive delivers."""

    def friction(self, world: World, values: Values) -> None:
        """Change ``world.friction_level``."""

    def force(self, world: World, values: Values) -> None:
        """Add to ``world.applied``, or call ``push_motor`` or ``drag_motor``."""

    def separates(self, values: Values) -> NDArray[np.bool_] | None:
        """(rows, joints) where the transmission is not rigid, or None."""
        return None

    def gear(self, gear: Gear, world: World, values: Values) -> None:
        """Change the transmission between motor and link; once, before the first step."""

    def sense(
        self, time: FloatArray, position: FloatArray, velocity: FloatArray, values: Values
    ) -> tuple[FloatArray, FloatArray]:
        """Sensor readings of (rows, samples, joints) trajectories."""
        return position, velocity

    def unsense(
        self, position: FloatArray, velocity: FloatArray, values: Values
    ) -> tuple[FloatArray, FloatArray]:
        """True (rows, joints) state from the measured state: the inverse of ``sense``."""
        return position, velocity

    def sense_effort(self, effort: FloatArray, values: Values) -> FloatArray:
        """Effort sensor readings of (rows, samples, joints) efforts."""
        return effort


def find_elastic_joints(
    effects: Sequence[tuple[Effect, Values]], shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    """(rows, joints) where the transmission is not rigid."""
    is_elastic = np.zeros(shape, dtype=bool)
    for effect, v in effects:
        elastic = effect.separates(v)
        if elastic is not None:
            is_elastic |= elastic
    return is_elastic


@dataclass(slots=True)
class ModelFields:
    """Model fields that effects may change, (rows, joints) unless noted.

    Attributes:
        armature: reflected inertia of the drive, kg*m^2 or kg.
        friction: dry friction of the model, N*m or N.
        constant_force: constant generalized force, N*m or N.
        motor_force: constant force on the motor side of an elastic transmission, N*m or N.
        stiffness: passive spring about the model's rest position, N*m/rad or N/m.
        gravity: (rows, 3) m/s^2, world frame.
        added_mass: (rows, joints) kg, on the link that the joint moves.
        added_at: (rows, joints, 3) position of the added mass, m from the joint: along the link
            (from the joint to the link's centre of mass; for a flange along the joint's axis), in
            the joint's direction of motion there, and perpendicular to both.
        mass_scale, inertia_scale: (rows, joints) factors on that link's mass, and on its inertia
            about its centre of mass.
        center_radial, center_tangential: (rows, joints) shift of that centre, m: away from the
            joint's axis, and in the joint's direction of motion.
        contact_offset: (rows,) or (1,) m, of the surfaces that the robot touches.
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
        """Fields that leave the model unchanged, under (rows, 3) gravity."""
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
        """(rows, joints) whose links have a shifted centre of mass."""
        return np.asarray((self.center_radial != 0.0) | (self.center_tangential != 0.0))

    @property
    def has_changed_links(self) -> bool:
        """Whether any link's mass, centre of mass or inertia is changed."""
        scaled = (self.mass_scale != 1.0) | (self.inertia_scale != 1.0)
        return bool((scaled | self.center_moves | (self.added_mass != 0.0)).any())

    def split_force(self, is_elastic: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
        """(rows, joints) constant forces on links and on motors, N*m or N.

        Args:
            is_elastic: (rows, joints) whether the transmission is elastic; otherwise a force on the
                motor acts on the link.
        """
        link: FloatArray = self.constant_force + np.where(is_elastic, 0.0, self.motor_force)
        motor: FloatArray = np.where(is_elastic, self.motor_force, 0.0)
        return link, motor
