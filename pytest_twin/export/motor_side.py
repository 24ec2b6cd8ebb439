"""A motor-side joint for an elastic transmission or a gear with backlash, in MJCF.

The link keeps its joint, so that recordings, limits and frames stay as they are. The motor turns a
joint of its own. It takes the drive, the armature, the damping and the dry friction of the link's
joint. A tendon of the length ``motor - link`` couples both: its spring is an elastic transmission,
its limits are the tooth flanks of a gap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from pytest_twin.effects.motor_side import MAX_STIFFNESS, TOOTH_DAMPING
from pytest_twin.realization import inertia
from pytest_twin.realization.mjcf import compile_spec

SUFFIX = "_motor"
_ROTOR_MASS, _ROTOR_INERTIA = 1e-6, 1e-9
"""Mass and inertia of the rotor's body, kg and kg*m^2: its inertia is the joint's armature."""
_SOFT = 1e-4
"""Impedance of the limit with which MuJoCo's constraint is a spring: the smallest that it has."""
_WIDTH = 1e-3
_FINEST = 8
"""Largest factor by which the time step of a model becomes smaller for a stiff transmission."""


@dataclass(frozen=True, slots=True)
class Transmission:
    """An elastic transmission of one joint.

    Attributes:
        compliance: rad/(N*m) or m/N.
        damping_time: damping divided by stiffness, s; None for nearly aperiodic teeth.
        gap: backlash, rad or m; 0 without any.
    """

    compliance: float
    damping_time: float | None
    gap: float


@dataclass(frozen=True, slots=True)
class MotorJoint:
    """A written motor-side joint.

    Attributes:
        joint, motor: names of the link's joint and of the motor's.
        stiffness: N*m/rad or N/m.
        gap: rad or m.
        timestep: time step that the transmission needs, s.
        is_limited: whether the model's stiffness is below that of the effect.
    """

    joint: str
    motor: str
    stiffness: float
    gap: float
    timestep: float
    is_limited: bool


def add_motor_side(spec: mujoco.MjSpec, joint_name: str, gear: Transmission) -> MotorJoint | None:
    """Give a joint a motor side; None for a joint without rotor inertia, which has no motion.

    Args:
        spec: changed in place; its time step may become smaller.
        gear: the transmission.
    """
    model = compile_spec(spec)[0]
    joint = spec.joint(joint_name)
    dof = int(model.joint(joint_name).dofadr[0])
    armature = float(model.dof_armature[dof])
    if armature <= 0.0:
        return None
    step = float(spec.option.timestep)
    wanted = 1.0 / max(gear.compliance, 1e-12)
    needed = math.sqrt(MAX_STIFFNESS * armature / wanted)
    fine = step / min(_FINEST, max(1, math.ceil(step / needed)))
    stiffness = min(wanted, MAX_STIFFNESS * armature / fine**2)
    damping = (
        TOOTH_DAMPING * math.sqrt(stiffness * armature)
        if gear.damping_time is None
        else gear.damping_time * stiffness
    )
    spec.option.timestep = fine
    motor = _add_motor_joint(spec, joint, model, dof)
    tendon = spec.add_tendon(name=f"{joint_name}_transmission")
    tendon.wrap_joint(motor, 1.0)
    tendon.wrap_joint(joint_name, -1.0)
    if gear.gap > 0.0:
        _write_flanks(spec, tendon.name, gear.gap, stiffness, damping)
    else:
        tendon.stiffness = _first(tendon.stiffness, stiffness)
        tendon.damping = _first(tendon.damping, damping)
        tendon.springlength = [0.0, 0.0]
    return MotorJoint(joint_name, motor, stiffness, gear.gap, fine, stiffness < 0.999 * wanted)


def _first(current: object, value: float) -> object:
    """Value of an attribute that may be a polynomial: its first coefficient."""
    return value if np.ndim(current) == 0 else [value, *([0.0] * (np.size(current) - 1))]  # type: ignore[arg-type]


def _add_motor_joint(
    spec: mujoco.MjSpec, joint: mujoco.MjsJoint, model: mujoco.MjModel, dof: int
) -> str:
    """Add the motor's body and joint, and move the drive side of the link's joint to it."""
    link = joint.parent
    body = link.parent.add_body(name=f"{joint.name}{SUFFIX}_rotor", pos=link.pos, quat=link.quat)
    inertia.write(body, _ROTOR_MASS, np.zeros(3), _ROTOR_INERTIA * np.eye(3))
    motor = body.add_joint(
        name=f"{joint.name}{SUFFIX}", type=joint.type, axis=joint.axis, pos=joint.pos
    )
    motor.armature = float(model.dof_armature[dof])
    motor.frictionloss = float(model.dof_frictionloss[dof])
    motor.damping = joint.damping
    motor.solref_friction[:] = joint.solref_friction
    motor.solimp_friction[:] = joint.solimp_friction
    motor.ref = joint.ref
    motor.limited = mujoco.mjtLimited.mjLIMITED_FALSE
    joint.armature, joint.frictionloss = 0.0, 0.0
    joint.damping = np.zeros_like(np.asarray(joint.damping)) if np.ndim(joint.damping) else 0.0
    for actuator in spec.actuators:
        if actuator.trntype in (
            mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT,
        ) and actuator.target == joint.name:  # fmt: skip
            actuator.target = motor.name
    return str(motor.name)


def _write_flanks(
    spec: mujoco.MjSpec, tendon_name: str, gap: float, stiffness: float, damping: float
) -> None:
    """Write the tooth flanks: limits that push with stiffness and damping, and never pull.

    With an impedance ``d`` close to 0, the force of MuJoCo's constraint is ``-(k x + b v) /
    (invweight (1 - d))``, where ``k`` and ``b`` are the two negative numbers of ``solref`` (MuJoCo,
    Computation, Constraint model).
    """
    tendon = spec.tendon(tendon_name)
    tendon.range = [-gap / 2.0, gap / 2.0]
    tendon.limited = mujoco.mjtLimited.mjLIMITED_TRUE
    tendon.solimp_limit = [_SOFT, _SOFT, _WIDTH, 0.5, 2.0]
    model = compile_spec(spec)[0]
    weight = float(model.tendon_invweight0[model.tendon(tendon_name).id])
    scale = weight * (1.0 - _SOFT)
    tendon.solref_limit = [-stiffness * scale, -damping * scale]
