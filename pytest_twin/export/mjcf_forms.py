"""Effects in plain MJCF, also those for which the diagnosis needs its own simulation."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import mujoco

from pytest_twin.asset.loss.matrix import Verdict
from pytest_twin.diagnosis.patched.model import AppliedEffect
from pytest_twin.diagnosis.patched.native import NativeWriter
from pytest_twin.effects import actuation, directional, friction, sensing, servo, timing
from pytest_twin.effects.contact_geoms import ContactGeoms
from pytest_twin.effects.layout import Layout
from pytest_twin.effects.transmission import Backlash, JointCoupling, JointElasticity, JointSpring
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.export.drive import SMALL_CONSTANT, DriveLaw, write_drive
from pytest_twin.export.expression import Expression
from pytest_twin.export.losses import LOSSES
from pytest_twin.export.motor_side import MotorJoint, Transmission, add_motor_side
from pytest_twin.realization.engine import HAS_CONTROL_INPUTS, NO_INPUT
from pytest_twin.trial import CommandMode

READING = "_reading"
"""Suffix of the sensor that reads a joint as its encoder does, where the joint itself does not."""
_BRISTLE_SHARE = 0.1
"""Stiffness of the bristles of a dry friction whose law has none, as a share of what a time step
resolves (inertia divided by the step squared)."""
_REMAINING_SHARE = 0.05
"""Share of the extra friction at rest that these bristles keep in motion, taken from the constant
level: a level of 0 has no bristles."""
_LEAST_SHARE = 1e-3
"""That share where there is no constant level; it is too much friction in motion."""
_SPARE_SAMPLES = 3
"""Samples of a delay line beyond the delay itself."""


@dataclass(frozen=True, slots=True)
class Form:
    """How one effect was written: the elements, and what is missing."""

    written: str
    verdict: Verdict = "kept"
    why: str = ""


@dataclass(slots=True)
class Reading:
    """How the encoder of a joint differs from the joint's own position; the sensor has that name.

    Attributes:
        scale: factor.
        neighbours: other joint -> its share of the reading.
        delay: s.
    """

    scale: float = 1.0
    neighbours: dict[str, float] = field(default_factory=dict)
    delay: float = 0.0


@dataclass(frozen=True, slots=True)
class ExportedMjcf:
    """A spec with all effects that MuJoCo expresses.

    Attributes:
        expressions: one for each effect.
        motors: joint -> its motor-side joint.
        readings: joint -> how its sensor reads it; other joints read their own position.
        drives: joint -> name of its actuator.
        bristles: names of the actuators with bristles that are as stiff as the time step resolves.
    """

    spec: mujoco.MjSpec
    expressions: tuple[Expression, ...]
    motors: Mapping[str, MotorJoint]
    readings: Mapping[str, Reading]
    drives: Mapping[str, str]
    bristles: frozenset[str]


class MjcfExporter:
    """Writes effects into a spec, one after another; :meth:`finish` returns the result.

    Args:
        spec: the patched model of one controller and payload; changed.
        joints: names of the joints, in the order of the effects' columns.
        contact: returns the geoms that contact effects act on.
        for_mjx: whether the spec is for MJX, which has no ``pid``, no ``dcmotor`` and no delays.
    """

    def __init__(
        self,
        spec: mujoco.MjSpec,
        joints: Sequence[str],
        contact: Callable[[], ContactGeoms],
        *,
        for_mjx: bool = False,
    ) -> None:
        self.for_mjx = for_mjx
        model = spec.compile()
        self.layout = Layout.of_model(model, joints)
        self.native = NativeWriter(spec, joints, self.layout, contact)
        self.drives: dict[str, DriveLaw] = {}
        self.gears: dict[str, list[AppliedEffect]] = {}
        self.readings: dict[str, Reading] = {}
        self.biases: dict[str, float] = {}
        self.cogging: list[tuple[str, float, int, float]] = []
        self.bristles: dict[str, tuple[str, float]] = {}
        """Motor with bristles -> its joint, and the friction that it has in motion."""
        self._expressions: dict[tuple[str, str | None], Expression] = {}
        self._of_drive: dict[str, list[AppliedEffect]] = {}
        self._passive = 0

    @property
    def spec(self) -> mujoco.MjSpec:
        """The spec."""
        return self.native.spec

    @property
    def model(self) -> mujoco.MjModel:
        """The spec, compiled."""
        return self.native.model

    def add(self, effect: AppliedEffect) -> None:
        """Write one effect, or the part of it that the spec does not hold yet."""
        if self.for_mjx and effect.effect in _NOT_IN_MJX:
            self._note(effect, self._without_mjx(effect))
            return
        if not HAS_CONTROL_INPUTS and _NOT_IN_MJX.get(effect.effect) == _MJX:
            self._note(effect, _lost(effect, _OLD))
            return
        if effect.is_in_mjcf:
            self._note(effect, Form(effect.written or "already in the model"))
            return
        column = -1 if effect.joint is None else self.native.joints.index(effect.joint)
        for part in self.native.write(Term(effect.effect, column), effect.values):
            self._note(part, Form(part.written) if part.is_in_mjcf else self._form(part, column))

    def _without_mjx(self, effect: AppliedEffect) -> Form:
        for actuator in self.spec.actuators:
            # The delay lines of the model are those of the effect.
            if effect.effect == timing.CommandDelay.id:
                actuator.delay, actuator.nsample = 0.0, 0
        self.native.model = self.spec.compile()
        return _lost(effect, _NOT_IN_MJX[effect.effect])

    def _form(self, effect: AppliedEffect, column: int) -> Form:
        write = _FORMS.get(effect.effect)
        if write is None:
            return _lost(effect)
        return write(self, effect, column)

    def finish(self) -> ExportedMjcf:
        """Write what several effects share: drives, readings, zeros and motor sides."""
        for joint, law in self.drives.items():
            self._write_drive(joint, law)
        for joint, bias in self.biases.items():
            self._shift_zero(joint, bias)
        for joint, amplitude, harmonic, phase in self.cogging:
            shifted = phase - harmonic * self.biases.get(joint, 0.0)
            self.passive(joint, "ripple", cogging=[amplitude, harmonic, shifted])
        for joint, reading in self.readings.items():
            self._write_reading(joint, reading)
        motors = {joint: self._write_gear(joint, parts) for joint, parts in self.gears.items()}
        joints = self.native.joints
        return ExportedMjcf(
            self.spec,
            tuple(self._expressions.values()),
            {joint: motor for joint, motor in motors.items() if motor is not None},
            self.readings,
            {
                joint: name
                for at, joint in enumerate(joints)
                if (name := self.native.actuator_name(at))
            },
            frozenset(self.bristles),
        )

    def drive(self, column: int) -> mujoco.MjsActuator | None:
        """The actuator of a joint, None without one."""
        name = self.native.actuator_name(column)
        return None if name is None else self.spec.actuator(name)

    def mode(self, column: int) -> CommandMode | Literal["none"]:
        """Command mode of a joint: ``position``, ``velocity``, ``effort`` or ``none``."""
        mode: CommandMode | Literal["none"] = str(self.layout.servo[column])  # type: ignore[assignment]
        return mode

    def of_drive(self, effect: AppliedEffect, **values: float) -> Form:
        """Note values of a drive's law; :meth:`finish` writes them, and decides the verdict."""
        assert effect.joint is not None
        law = self.drives.setdefault(effect.joint, DriveLaw())
        for name, value in values.items():
            setattr(law, name, value)
        self._of_drive.setdefault(effect.joint, []).append(effect)
        return Form("", "lost")

    def passive(
        self,
        joint: str,
        element: str,
        *,
        cogging: Sequence[float] = (),
        lugre: Sequence[float] = (),
    ) -> str:
        """Add a motor without input, current and control: a passive force on a joint.

        Returns:
            Its name.
        """
        self._passive += 1
        name = f"{joint}_{element}_{self._passive}"
        actuator = self.spec.add_actuator(name=name, target=joint)
        actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
        actuator.set_to_dcmotor(
            motorconst=[SMALL_CONSTANT, SMALL_CONSTANT], resistance=1.0,
            cogging=list(cogging) or [0.0] * 3, lugre=list(lugre) or [0.0] * 5,
            ctrlspec=NO_INPUT,
        )  # fmt: skip
        return name

    def constant(self, joint: str, effort: float) -> str:
        """Add a constant effort on a joint, N*m or N: a cogging torque with no poles."""
        name = self.passive(joint, "constant", cogging=[effort, 0.0, math.pi / 2.0])
        return f"dcmotor '{name}' without input"

    def inertia(self, column: int) -> float:
        """Inertia that a force on a joint moves at least: its armature and its link, SI units."""
        dof = int(self.layout.dof_index[column])
        return float(self.model.dof_M0[dof])

    # -- parts that several effects share

    def _note(self, effect: AppliedEffect, form: Form) -> None:
        place = effect.effect, effect.joint
        known = self._expressions.get(place)
        new = Expression(*place, dict(effect.values), form.verdict, form.written, form.why)
        if known is not None:
            same = known.verdict == new.verdict
            new = Expression(
                *place,
                {**known.values, **new.values},
                new.verdict if same else "changed",
                "; ".join(dict.fromkeys(w for w in (known.written, new.written) if w)),
                "; ".join(dict.fromkeys(w for w in (known.why, new.why) if w)),
            )
        self._expressions[place] = new

    def _decide(self, effect: AppliedEffect, form: Form) -> None:
        place = effect.effect, effect.joint
        self._expressions.pop(place, None)
        self._note(effect, form)

    def _write_drive(self, joint: str, law: DriveLaw) -> None:
        column = self.native.joints.index(joint)
        actuator, mode = self.drive(column), self.mode(column)
        element = None
        if actuator is not None and mode != "none" and not self.for_mjx:
            element = write_drive(actuator, mode, law, constant=float(actuator.biasprm[0]))
        for effect in self._of_drive[joint]:
            if element is None:
                why = f"MuJoCo has no actuator for a {mode} drive with this law"
                self._decide(effect, Form("", "lost", why))
            else:
                assert actuator is not None
                why = _OF_DRIVES.get(effect.effect, "")
                self._decide(effect, Form(f"actuator '{actuator.name}' {element}", why=why))
        self.native.model = self.spec.compile()

    def _shift_zero(self, joint: str, bias: float) -> None:
        """Move the zero of a joint, so that its position is what the encoder reads."""
        model = self.model
        at = model.joint(joint)
        address = int(at.qposadr[0])
        changed: dict[str, object] = {
            "ref": float(model.qpos0[address]) + bias,
            "springref": float(model.qpos_spring[address]) + bias,
        }
        if model.jnt_limited[at.id]:
            changed["range"] = (model.jnt_range[at.id] + bias).tolist()
        self.native.fit("joint", joint, changed)
        for key in self.spec.keys:
            if len(key.qpos) == model.nq:
                key.qpos = [
                    value + (bias if i == address else 0.0) for i, value in enumerate(key.qpos)
                ]
        self.native.model = self.spec.compile()

    def _write_reading(self, joint: str, reading: Reading) -> None:
        name = f"{joint}{READING}"
        sensor = self.spec.add_sensor(name=name, objname=joint)
        sensor.type = mujoco.mjtSensor.mjSENS_JOINTPOS
        sensor.objtype = mujoco.mjtObj.mjOBJ_JOINT
        if reading.scale != 1.0 or reading.neighbours:
            tendon = self.spec.add_tendon(name=name)
            tendon.wrap_joint(joint, reading.scale)
            for neighbour, ratio in reading.neighbours.items():
                tendon.wrap_joint(neighbour, ratio)
            sensor.type, sensor.objtype = (
                mujoco.mjtSensor.mjSENS_TENDONPOS, mujoco.mjtObj.mjOBJ_TENDON,
            )  # fmt: skip
            sensor.objname = name
        if reading.delay > 0.0:
            sensor.delay, sensor.interp = reading.delay, 1
            sensor.nsample = math.ceil(reading.delay / self.spec.option.timestep) + _SPARE_SAMPLES

    def _write_gear(self, joint: str, parts: Sequence[AppliedEffect]) -> MotorJoint | None:
        compliance, gap, damping_time = 0.0, 0.0, None
        for part in parts:
            if part.effect == Backlash.id:
                compliance += part.values["tooth_compliance"]
                gap += part.values["gap"]
            else:
                compliance += part.values["compliance"]
                damping_time = part.values["damping_time"]
        motor = add_motor_side(self.spec, joint, Transmission(compliance, damping_time, gap))
        for part in parts:
            if motor is None:
                why = "the joint has no armature: a motor without inertia has no motion of its own"
                self._decide(part, Form("", "lost", why))
                continue
            written = (
                f"joint '{motor.motor}' and tendon '{joint}_transmission'; time step "
                f"{motor.timestep:g} s"
            )
            verdict: Verdict = "changed" if motor.is_limited else "kept"
            why = (
                f"stiffness {motor.stiffness:.4g}, the largest that this time step resolves"
                if motor.is_limited
                else ""
            )
            self._decide(part, Form(written, verdict, why))
        self.native.model = self.spec.compile()
        return motor


def _lost(effect: AppliedEffect, why: str = "") -> Form:
    return Form("", "lost", why or LOSSES.get(effect.effect, "MuJoCo has no such law"))


def _lag(x: MjcfExporter, effect: AppliedEffect, column: int) -> Form:
    time_constant = effect.values["time_constant"]
    if x.mode(column) != "effort":
        if effect.values["of_setpoint"] > 0.0:
            return _lost(effect, "the drive already has a state of its own")
        return x.of_drive(effect, lag=time_constant)
    actuator = x.drive(column)
    if actuator is None or actuator.dyntype != mujoco.mjtDyn.mjDYN_NONE:
        return _lost(effect, "no actuator of the joint is free for a filter")
    actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
    actuator.dynprm[0] = time_constant
    return Form(f"actuator '{actuator.name}' filtered activation")


def _rate(x: MjcfExporter, effect: AppliedEffect, column: int) -> Form:
    if effect.values["inverse_effort_rate"] > 0.0:
        return _lost(effect)
    gear = abs(float(x.layout.gear[column]))
    return x.of_drive(effect, slew=gear / effect.values["inverse_rate"])


def _speed_limit(x: MjcfExporter, effect: AppliedEffect, column: int) -> Form:
    gear = abs(float(x.layout.gear[column]))
    return x.of_drive(
        effect,
        stall=effect.values["stall"] / gear,
        no_load_speed=gear / effect.values["inverse_no_load_speed"],
    )


def _integral(x: MjcfExporter, effect: AppliedEffect, column: int) -> Form:
    return x.of_drive(effect, integral_time=1.0 / effect.values["inverse_integral_time"])


def _cogging(x: MjcfExporter, effect: AppliedEffect, column: int) -> Form:
    sine, cosine, harmonic = (effect.values[name] for name in ("sine", "cosine", "harmonic"))
    if abs(harmonic - round(harmonic)) > 1e-9:
        return _lost(effect, "MuJoCo takes whole numbers of periods in a turn (1 rad: 2 pi) alone")
    assert effect.joint is not None
    x.cogging.append(
        (effect.joint, math.hypot(sine, cosine), round(harmonic), math.atan2(cosine, sine))
    )
    return Form(f"dcmotor '{effect.joint}_ripple' without input")


def _presliding(x: MjcfExporter, effect: AppliedEffect, column: int) -> Form:
    level, distance = effect.values["coulomb"], effect.values["presliding_distance"]
    if level <= 0.0:
        return _lost(effect, "bristles need a positive friction level")
    assert effect.joint is not None
    name = x.passive(effect.joint, "presliding", lugre=[level / distance, 0.0, level, level, 1.0])
    return Form(f"dcmotor '{name}' without input, lugre")


def _stribeck(x: MjcfExporter, effect: AppliedEffect, column: int) -> Form:
    excess, level = effect.values["stiction_excess"], effect.values["coulomb"]
    assert effect.joint is not None
    if excess <= 0.0:
        (native,) = x.native.write(Term(friction.CoulombFriction.id, column), {"coulomb": level})
        return Form(native.written)
    before = float(x.model.dof_frictionloss[x.layout.dof_index[column]])
    # The bristles carry a part of the friction in motion, and the constant level the rest.
    available = before + level
    remaining = max(min(_REMAINING_SHARE * excess, available), _LEAST_SHARE * excess)
    (native,) = x.native.write(
        Term(friction.CoulombFriction.id, column),
        {"coulomb": level - min(remaining, available)},
    )
    inertia, step = x.inertia(column), float(x.spec.option.timestep)
    stiffness = _BRISTLE_SHARE * inertia / step**2
    name = x.passive(
        effect.joint, "stiction",
        lugre=[
            stiffness, 0.0, remaining, remaining + excess, effect.values["stribeck_velocity"],
        ],
    )  # fmt: skip
    x.bristles[name] = effect.joint, remaining
    return Form(
        f"{native.written}; dcmotor '{name}' without input, lugre",
        "kept",
        "the extra friction at rest gives before it slides, as little as the time step resolves",
    )


def _position_friction(x: MjcfExporter, effect: AppliedEffect, column: int) -> Form:
    native = x.native.write(
        Term(friction.CoulombFriction.id, column), {"coulomb": effect.values["mean"]}
    )
    return Form(native[0].written, "changed", "MuJoCo's dry friction does not vary with position")


def _offset(x: MjcfExporter, effect: AppliedEffect, column: int) -> Form:
    assert effect.joint is not None
    return Form(x.constant(effect.joint, -effect.values["offset"]))


def _spring(x: MjcfExporter, effect: AppliedEffect, column: int) -> Form:
    assert effect.joint is not None
    if effect.values["stiffness"] != 0.0 or x.for_mjx or not HAS_CONTROL_INPUTS:
        return _lost(effect, "MJCF joints have no negative stiffness, and no effort without one")
    return Form(x.constant(effect.joint, effect.values["preload"]))


def _transmission(x: MjcfExporter, effect: AppliedEffect, column: int) -> Form:
    assert effect.joint is not None
    x.gears.setdefault(effect.joint, []).append(effect)
    return Form("", "lost")


def _coupling(x: MjcfExporter, effect: AppliedEffect, column: int) -> Form:
    form, ratio = round(effect.values["form"]), effect.values["ratio"]
    neighbour = column - 1 if form % 2 == 0 else column + 1
    joints = x.native.joints
    if not 0 <= neighbour < len(joints):
        return _lost(effect, "there is no such neighbour")
    if form >= 4:
        x.readings.setdefault(joints[column], Reading()).neighbours[joints[neighbour]] = ratio
        return Form(f"sensor '{joints[column]}{READING}'")
    # The actuator that acts on both joints: its own joint first, then the share of the other.
    driven, other, share = (column, neighbour, -ratio) if form >= 2 else (neighbour, column, ratio)
    actuator = x.drive(driven)
    if actuator is None or (form < 2 and x.mode(driven) != "effort"):
        return _lost(effect, "a MuJoCo actuator measures the tendon on which it acts")
    tendon = x.spec.add_tendon(name=f"{joints[driven]}_coupling")
    tendon.wrap_joint(joints[driven], 1.0)
    tendon.wrap_joint(joints[other], share)
    actuator.trntype, actuator.target = mujoco.mjtTrn.mjTRN_TENDON, tendon.name
    x.native.model = x.spec.compile()
    return Form(f"actuator '{actuator.name}' on tendon '{tendon.name}'")


def _encoder_bias(x: MjcfExporter, effect: AppliedEffect, column: int) -> Form:
    assert effect.joint is not None
    bias = effect.values["bias"]
    x.biases[effect.joint] = x.biases.get(effect.joint, 0.0) + bias
    actuator = x.drive(column)
    written = f"joint '{effect.joint}' ref, range and springref"
    if effect.values["in_loop"] == 0.0 and actuator is not None:
        length = float(x.layout.gear[column]) * bias
        actuator.biasprm[0] -= float(actuator.biasprm[1]) * length
        written += f"; actuator '{actuator.name}' biasprm"
    return Form(written)


def _encoder_scale(x: MjcfExporter, effect: AppliedEffect, column: int) -> Form:
    assert effect.joint is not None
    x.readings.setdefault(effect.joint, Reading()).scale *= 1.0 + effect.values["scale_error"]
    return Form(f"sensor '{effect.joint}{READING}'")


def _sensor_delay(x: MjcfExporter, effect: AppliedEffect, column: int) -> Form:
    for joint in x.native.joints:
        x.readings.setdefault(joint, Reading()).delay += effect.values["delay"]
    return Form(f"sensors '*{READING}' delay")


def _directional(x: MjcfExporter, effect: AppliedEffect, column: int) -> Form:
    return Form("", "lost", "MuJoCo's damping is the same in both directions")


_MJX = "MJX has neither pid nor dcmotor"
_OLD = f"MuJoCo {mujoco.__version__} has no motor without input: 3.12 or newer has"
_STEPS = "MJX has no delay lines: hold commands for this time in the environment"
_NOT_IN_MJX: Mapping[str, str] = {
    timing.CommandDelay.id: _STEPS,
    timing.SensorDelay.id: "MJX has no delayed sensors: hold readings in the environment",
    **dict.fromkeys(
        (
            actuation.RateLimit.id, actuation.TorqueSpeedLimit.id, actuation.Cogging.id,
            servo.IntegralGain.id, friction.PreslidingHysteresis.id, friction.StribeckFriction.id,
            friction.AsymmetricFriction.id,
        ),
        _MJX,
    ),
}  # fmt: skip
"""Effect -> why MJX lacks what MuJoCo has for it."""
_OF_DRIVES: Mapping[str, str] = {
    actuation.TorqueSpeedLimit.id: "above its no-load speed a dcmotor brakes by its back-EMF; the "
    "diagnosed law has no effort there",
}
"""Effect of a drive -> what its actuator does otherwise."""
_FORMS: Mapping[str, Callable[[MjcfExporter, AppliedEffect, int], Form]] = {
    actuation.ActuatorLag.id: _lag,
    actuation.RateLimit.id: _rate,
    actuation.TorqueSpeedLimit.id: _speed_limit,
    actuation.Cogging.id: _cogging,
    servo.IntegralGain.id: _integral,
    friction.PreslidingHysteresis.id: _presliding,
    friction.StribeckFriction.id: _stribeck,
    friction.PositionDependentFriction.id: _position_friction,
    friction.AsymmetricFriction.id: _offset,
    directional.DirectionalViscousFriction.id: _directional,
    JointSpring.id: _spring,
    Backlash.id: _transmission,
    JointElasticity.id: _transmission,
    JointCoupling.id: _coupling,
    sensing.EncoderBias.id: _encoder_bias,
    sensing.EncoderScale.id: _encoder_scale,
    timing.SensorDelay.id: _sensor_delay,
}
