"""Check what only a simulation model states: gravity, contact, drives, springs and keyframes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import mujoco
import numpy as np

from pytest_twin.audit.asset import Vector
from pytest_twin.audit.finding import Finding, Place, finding_of
from pytest_twin.audit.loads import GRAVITY, MOST_LIFTS

_GRAVITY = (1.0, 20.0)
"""m/s^2: downwards, from the Moon to twice the Earth."""
_TIME_STEP = 0.05
"""s: no engine holds a contact of a robot at larger steps."""
_TURN = 2 * math.pi
_SLOW = 0.1
"""rad/s: a joint whose damping takes its whole effort below this speed cannot be used."""
_SLACK = 0.02
"""Fraction of a range by which a keyframe may leave it, as at a soft stop."""
_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)

PlaceOf = Callable[[str, int], Place]
NameOf = Callable[[str, int], str]


def check(model: mujoco.MjModel, place: PlaceOf, name: NameOf) -> Iterator[Finding]:
    """Yield findings of a compiled model.

    Args:
        place: kind and id of an element -> file and line.
        name: kind and id of an element -> name.
    """
    yield from _world(model, place("body", 0))
    weights = _weights(model)
    for joint in range(model.njnt):
        if int(model.jnt_type[joint]) in (_HINGE, _SLIDE):
            yield from _Joint(model, joint, place, name).check(weights)
    for actuator in range(model.nactuator):
        yield from _commands(model, actuator, place, name)
    for key in range(model.nkey):
        yield from _keyframe(model, key, place, name)


def _world(model: mujoco.MjModel, place: Place) -> Iterator[Finding]:
    gravity = np.array(model.opt.gravity)
    off = bool(model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    down = -float(gravity[2])
    sideways = float(np.linalg.norm(gravity[:2]))
    if off or not (_GRAVITY[0] <= down <= _GRAVITY[1] and sideways < 0.5 * down):
        yield finding_of(
            "frames.gravity",
            place,
            "option 'gravity'",
            "off" if off else " ".join(f"{value:g}" for value in gravity),
            title="gravity is off"
            if off or not gravity.any()
            else "gravity does not point down, or is not the Earth's",
        )
    if model.opt.timestep > _TIME_STEP:
        yield finding_of(
            "controllers.time_step", place, "option 'timestep'", float(model.opt.timestep)
        )
    collides = (np.asarray(model.geom_contype) | np.asarray(model.geom_conaffinity)).any()
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT and collides:
        yield finding_of(
            "meshes.masked",
            place,
            "option 'flag'",
            title="contact is disabled: its collision shapes collide with nothing",
        )


class _Joint:
    """A scalar joint with the actuators that drive it alone."""

    def __init__(self, model: mujoco.MjModel, joint: int, place: PlaceOf, name: NameOf) -> None:
        self.model, self.joint = model, joint
        self.place = place("joint", joint)
        self.name = name("joint", joint)
        self.dof = int(model.jnt_dofadr[joint])
        self.is_hinge = int(model.jnt_type[joint]) == _HINGE
        self.unit, self.effort_unit = ("rad", "N*m") if self.is_hinge else ("m", "N")
        self.actuators = [
            index for index in range(model.nactuator) if _joint_of(model, index) == joint
        ]

    def check(self, weights: Vector) -> Iterator[Finding]:
        """Yield findings; ``weights`` (nv,) is what gravity needs of each drive, N*m or N."""
        element, model = f"joint '{self.name}'", self.model
        if not model.jnt_limited[self.joint] and np.ptp(model.jnt_range[self.joint]) > 0:
            low, high = model.jnt_range[self.joint]
            yield finding_of(
                "joints.idle_range", self.place, element, f"{low:g} .. {high:g}", unit=self.unit
            )
        most = self._most_effort()
        armature = float(model.dof_armature[self.dof])
        inertia = float(model.body_subtreemass[0]) * float(model.stat.extent) ** 2
        if self.is_hinge and armature > 10 * inertia > 0:
            yield finding_of(
                "joints.armature_units",
                self.place,
                element,
                armature,
                expected=f"less than {10 * inertia:.3g} kg*m^2, 10 times the whole robot's",
            )
        if most is None or most <= 0:
            return
        weight = abs(float(weights[self.dof]))
        whole = GRAVITY * float(model.body_subtreemass[0])
        whole *= float(model.stat.extent) if self.is_hinge else 1.0
        if most < weight:
            yield finding_of(
                "joints.effort_too_small",
                self.place,
                element,
                most,
                title="its drive cannot hold the links that it carries, with all joints at or "
                "nearest to their reference",
                unit=self.effort_unit,
                expected=f"more than {weight:.3g} {self.effort_unit}",
            )
        elif most > MOST_LIFTS * whole > 0:
            yield finding_of(
                "joints.effort_units",
                self.place,
                element,
                most,
                title=f"its drive would lift the whole robot {most / whole:.0f} times",
                unit=self.effort_unit,
                expected=f"less than {MOST_LIFTS * whole:.3g} {self.effort_unit}",
            )
        friction = float(model.dof_frictionloss[self.dof])
        if friction >= most:
            yield finding_of(
                "joints.friction_above_effort",
                self.place,
                element,
                friction,
                unit=self.effort_unit,
                expected=f"less than its drive's {most:g} {self.effort_unit}",
            )
        damping = float(np.abs(model.dof_damping[self.dof]).max())
        if self.is_hinge and damping * _SLOW > most:
            yield finding_of(
                "joints.damping_above_effort",
                self.place,
                element,
                damping,
                title="its damping takes all that its drive has at "
                f"{most / damping:.2g} {self.unit}/s",
                unit=f"{self.effort_unit}*s/{self.unit}",
                expected=f"less than {most / _SLOW:.3g}",
            )
        spring = self._spring()
        if spring > most:
            yield finding_of(
                "joints.spring_above_effort",
                self.place,
                element,
                spring,
                unit=self.effort_unit,
                expected=f"less than its drive's {most:g} {self.effort_unit}",
            )

    def _most_effort(self) -> float | None:
        """Return the largest effort of the joint's actuators, N*m or N; None without a limit."""
        model, total = self.model, 0.0
        for index in self.actuators:
            output, control = int(model.actuator_outadr[index]), int(model.actuator_ctrladr[index])
            gear = abs(float(model.actuator_gear[output, 0]))
            constant = int(model.actuator_gaintype[index]) == int(mujoco.mjtGain.mjGAIN_FIXED)
            free = int(model.actuator_biastype[index]) == int(mujoco.mjtBias.mjBIAS_NONE)
            if model.actuator_forcelimited[output]:
                total += gear * float(np.abs(model.actuator_forcerange[output]).max())
            elif (
                constant
                and free
                and 0 <= control < model.nu
                and model.actuator_ctrllimited[control]
            ):
                gain = abs(float(model.actuator_gainprm[index, 0]))
                total += gear * gain * float(np.abs(model.actuator_ctrlrange[control]).max())
            else:
                total = math.inf
        if model.jnt_actfrclimited[self.joint] and self.actuators:
            total = min(total, float(np.abs(model.jnt_actfrcrange[self.joint]).max()))
        return total if self.actuators and math.isfinite(total) else None

    def _spring(self) -> float:
        """Return the smallest force of the joint's spring at both ends of its range, N*m or N."""
        model = self.model
        stiffness = float(np.ravel(model.jnt_stiffness[self.joint])[0])
        if stiffness <= 0 or not model.jnt_limited[self.joint]:
            return 0.0
        rest = float(model.qpos_spring[int(model.jnt_qposadr[self.joint])])
        return stiffness * float(np.abs(model.jnt_range[self.joint] - rest).min())


def _weights(model: mujoco.MjModel) -> Vector:
    """Return the (nv,) efforts that hold the model near its reference pose, less springs."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    for joint in range(model.njnt):
        if model.jnt_limited[joint] and int(model.jnt_type[joint]) in (_HINGE, _SLIDE):
            at = int(model.jnt_qposadr[joint])
            data.qpos[at] = np.clip(data.qpos[at], *model.jnt_range[joint])
    mujoco.mj_forward(model, data)
    return np.asarray(data.qfrc_bias - data.qfrc_passive)


def _joint_of(model: mujoco.MjModel, actuator: int) -> int | None:
    """Return the scalar joint that an actuator drives, or None."""
    kinds = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    joint = int(model.actuator_trnid[actuator, 0])
    if int(model.actuator_trntype[actuator]) not in kinds:
        return None
    return joint if int(model.jnt_type[joint]) in (_HINGE, _SLIDE) else None


def _has_limited_command(model: mujoco.MjModel, control: int) -> bool:
    return 0 <= control < model.nu and bool(model.actuator_ctrllimited[control])


def _commands(
    model: mujoco.MjModel, actuator: int, place: PlaceOf, name: NameOf
) -> Iterator[Finding]:
    """Yield findings of a position servo that runs away, or whose commands miss the range."""
    joint = _joint_of(model, actuator)
    affine = int(model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
    if joint is None or not affine:
        return
    element = f"actuator '{name('actuator', actuator)}'"
    stiffness = -float(model.actuator_biasprm[actuator, 1])
    if stiffness < 0:
        yield finding_of("commands.unstable", place("actuator", actuator), element, stiffness)
        return
    control = int(model.actuator_ctrladr[actuator])
    if stiffness == 0 or not _has_limited_command(model, control):
        return
    gain = float(model.actuator_gainprm[actuator, 0])
    gear = float(model.actuator_gear[int(model.actuator_outadr[actuator]), 0])
    offset = float(model.actuator_biasprm[actuator, 0])
    if gain == 0 or gear == 0 or not model.jnt_limited[joint]:
        return
    # At rest gain * command + offset = stiffness * gear * position.
    ends = (gain * np.asarray(model.actuator_ctrlrange[control]) + offset) / (stiffness * gear)
    low, high = float(ends.min()), float(ends.max())
    lower, upper = (float(end) for end in model.jnt_range[joint])
    is_hinge = int(model.jnt_type[joint]) == _HINGE
    far = max(low - upper, lower - high)
    beyond = max(lower - low, high - upper)
    if far > 0 or beyond > (_TURN if is_hinge else 10 * (upper - lower)):
        words = "never reach" if far > 0 else "go far beyond"
    elif high - low < 0.05 * (upper - lower):
        words = "reach less than a twentieth of"
    else:
        return
    unit = "rad" if is_hinge else "m"
    yield finding_of(
        "commands.range",
        place("actuator", actuator),
        element,
        f"{low:.4g} .. {high:.4g}",
        title=f"its commands {words} the range of joint '{name('joint', joint)}'",
        unit=unit,
        expected=f"{lower:.4g} .. {upper:.4g} {unit}",
    )


def _keyframe(model: mujoco.MjModel, key: int, place: PlaceOf, name: NameOf) -> Iterator[Finding]:
    """Yield a finding of a keyframe outside the range of a joint."""
    for joint in range(model.njnt):
        if not model.jnt_limited[joint] or int(model.jnt_type[joint]) not in (_HINGE, _SLIDE):
            continue
        position = float(model.key_qpos[key, int(model.jnt_qposadr[joint])])
        lower, upper = (float(end) for end in model.jnt_range[joint])
        slack = _SLACK * (upper - lower)
        if not lower - slack <= position <= upper + slack:
            yield finding_of(
                "joints.key_outside",
                place("joint", joint),
                f"joint '{name('joint', joint)}'",
                position,
                title=f"the keyframe '{name('key', key)}' is outside its range",
                unit="rad" if int(model.jnt_type[joint]) == _HINGE else "m",
                expected=f"{lower:.4g} .. {upper:.4g}",
            )
