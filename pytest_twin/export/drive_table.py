"""Drives of a diagnosed model as the numbers that a configuration of actuators takes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco

from pytest_twin.asset.loss.matrix import Verdict
from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.effects import actuation, friction, rigid_body, servo, timing
from pytest_twin.errors import SpecError
from pytest_twin.export.expression import Expression
from pytest_twin.export.mjcf_forms import MjcfExporter
from pytest_twin.realization import Realization

RIGID = ("rigid_body", "contact")
"""Families of effects that are in the robot's file, not in its drives."""


@dataclass(frozen=True, slots=True)
class DriveRow:
    """One drive, SI units at the joint.

    Attributes:
        joint: its joint.
        is_slide: whether the joint slides; units are then m and N.
        mode: quantity of its command: ``position``, ``velocity`` or ``effort``.
        stiffness, damping: gains of the servo; 0 for an effort drive.
        effort_limit: largest effort, None for no limit.
        armature, friction, viscous: rotor inertia, dry friction and viscous coefficient.
        stiction: dry friction at rest.
        delay: delay of the command, s.
        stall, no_load_speed: torque-speed limit; 0 for none.
        lag: time constant of the effort, s.
        slew: largest rate of the setpoint; 0 for no limit.
        integral_gain: 0 for none.
    """

    joint: str
    is_slide: bool
    mode: str
    stiffness: float
    damping: float
    effort_limit: float | None
    armature: float
    friction: float
    viscous: float
    stiction: float
    delay: float
    stall: float
    no_load_speed: float
    lag: float
    slew: float
    integral_gain: float


@dataclass(frozen=True, slots=True)
class DriveTable:
    """All drives of a model.

    Attributes:
        rows: one for each joint with a drive that has a linear law.
        timestep: time step of the model, s.
        omitted: joint -> why its drive is no row.
    """

    rows: tuple[DriveRow, ...]
    timestep: float
    omitted: Mapping[str, str]


def drive_table(realization: Realization, patched: PatchedModel) -> DriveTable:
    """The drives of a model with its effects.

    Raises:
        SpecError: a contact effect, which no drive has.
    """

    def no_contact() -> object:
        raise SpecError(
            "a contact effect is no property of a drive", path=realization.path,
            expected="--to mujoco",
        )  # fmt: skip

    exporter = MjcfExporter(realization.spec.copy(), patched.joints, no_contact)  # type: ignore[arg-type]
    for effect in patched.effects:
        exporter.add(effect)
    rows, omitted = [], {}
    for column, joint in enumerate(patched.joints):
        row = _row(exporter, patched, column, joint)
        if isinstance(row, str):
            omitted[joint] = row
        else:
            rows.append(row)
    return DriveTable(tuple(rows), float(exporter.model.opt.timestep), omitted)


def _row(exporter: MjcfExporter, patched: PatchedModel, column: int, joint: str) -> DriveRow | str:
    model, layout = exporter.model, exporter.layout
    at, mode = int(layout.actuator[column]), exporter.mode(column)
    if at < 0:
        return "no actuator drives it"
    gear = float(layout.gear[column])
    gain, bias = model.actuator_gainprm[at], model.actuator_biasprm[at]
    is_linear = int(model.actuator_gaintype[at]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    stiffness, damping = -float(bias[1]) * gear**2, -float(bias[2]) * gear**2
    if not is_linear or (mode == "position" and gain[0] != -bias[1]):
        return "its control law is no PD law"
    dof = int(layout.dof_index[column])
    law = exporter.drives.get(joint)
    limit = None
    if model.actuator_forcelimited[at]:
        low, high = (float(end) * abs(gear) for end in model.actuator_forcerange[at])
        limit = min(abs(low), abs(high))
    extra = sum(
        effect.values.get("stiction_excess", 0.0)
        for effect in patched.effects
        if effect.effect == friction.StribeckFriction.id and effect.joint == joint
    )
    in_motion = sum(level for at, level in exporter.bristles.values() if at == joint)
    dry = float(model.dof_frictionloss[dof]) + in_motion
    return DriveRow(
        joint, bool(layout.slides[column]), mode, stiffness, damping, limit,
        float(model.dof_armature[dof]), dry, float(model.dof_damping[dof]), dry + extra,
        float(model.actuator_delay[at]),
        0.0 if law is None else law.stall * abs(gear),
        0.0 if law is None else law.no_load_speed / abs(gear),
        0.0 if law is None else law.lag,
        0.0 if law is None else law.slew / abs(gear),
        stiffness / law.integral_time if law is not None and law.integral_time > 0.0 else 0.0,
    )  # fmt: skip


DRIVE_EFFECTS: Mapping[str, str] = {
    actuation.ControllerGain.id: "gains",
    actuation.TorqueConstant.id: "gains",
    actuation.TorqueSaturation.id: "effort_limit",
    rigid_body.Armature.id: "armature",
    friction.CoulombFriction.id: "friction",
    friction.ViscousFriction.id: "viscous",
    friction.StribeckFriction.id: "stiction",
    timing.CommandDelay.id: "delay",
    actuation.TorqueSpeedLimit.id: "speed_limit",
    actuation.ActuatorLag.id: "lag",
    actuation.RateLimit.id: "slew",
    servo.IntegralGain.id: "integral",
}
"""Effect -> the part of a drive that holds it."""


def expressions(
    patched: PatchedModel,
    written: Mapping[str, str],
    approximated: Mapping[str, str],
    families: Mapping[str, str],
) -> tuple[Expression, ...]:
    """How a configuration of actuators expresses each effect.

    Args:
        patched: the effects.
        written: part of a drive -> field of the target that holds it.
        approximated: the same -> what is missing, for parts that it holds in part.
        families: effect -> family.
    """
    merged: dict[tuple[str, str | None], dict[str, float]] = {}
    for effect in patched.effects:
        merged.setdefault((effect.effect, effect.joint), {}).update(effect.values)
    out = []
    for (effect_id, joint), values in merged.items():
        part = DRIVE_EFFECTS.get(effect_id, "")
        if families.get(effect_id) in RIGID and not part:
            text = "in model.xml: import it as the robot's asset"
            out.append(Expression(effect_id, joint, values, "kept", text))
        elif part == "lag" and values.get("of_setpoint", 0.0) > 0.0:
            out.append(Expression(effect_id, joint, values, "lost", "", "no filter of a setpoint"))
        elif part == "slew" and values.get("inverse_effort_rate", 0.0) > 0.0:
            out.append(
                Expression(effect_id, joint, values, "lost", "", "no rate limit of an effort")
            )
        elif part in written:
            missing = approximated.get(part, "")
            verdict: Verdict = "changed" if missing else "kept"
            out.append(Expression(effect_id, joint, values, verdict, written[part], missing))
        else:
            why = "the target's actuators have no such law"
            out.append(Expression(effect_id, joint, values, "lost", "", why))
    return tuple(out)


def steps_of(delay: float, timestep: float) -> int:
    """A delay in whole time steps."""
    return math.floor(delay / timestep + 0.5)


def rounding_note(rows: Sequence[DriveRow], timestep: float) -> str:
    """What whole steps of a delay change; empty where nothing is rounded."""
    worst = max((abs(r.delay - steps_of(r.delay, timestep) * timestep) for r in rows), default=0.0)
    return f"rounded to whole time steps, by up to {1e3 * worst:.2g} ms" if worst > 1e-6 else ""
