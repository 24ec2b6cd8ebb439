"""One joint driven by one input, the rest of the robot as declared: what step and frequency
response have in common."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.checks.fields import (
    EFFORT_UNIT,
    POSITION_UNIT,
    QUANTITY_SCHEMA,
    VELOCITY_UNIT,
    known_name,
    quantity,
    spec_error,
)
from pytest_twin.checks.poses import POSE_SCHEMA, REFERENCE, configuration, resolve_pose
from pytest_twin.errors import SpecError
from pytest_twin.golden import Golden

if TYPE_CHECKING:
    import mujoco

    from pytest_twin.realization import Realization
    from pytest_twin.realization.inputs import CommandInput

_UNITS: Mapping[str, Mapping[str, str]] = {
    "position": POSITION_UNIT,
    "velocity": VELOCITY_UNIT,
    "effort": EFFORT_UNIT,
}

TARGET_SCHEMA: Mapping[str, Any] = {
    "type": "object",
    "properties": {
        "joint": {"type": "string", "minLength": 1, "description": "Hinge or slide joint."},
        "command": {
            "enum": ["position", "velocity", "effort"],
            "description": "What is commanded: the mode of the joint's actuator by default; an "
            "effort acts on the joint itself where it has no actuator.",
        },
        "response": {
            "enum": ["position", "velocity"],
            "description": "What answers: position for a position command, else velocity.",
        },
    },
    "required": ["joint"],
    "additionalProperties": False,
}
BENCH_SCHEMA: Mapping[str, Any] = {
    "pose": POSE_SCHEMA,
    "gravity": {"type": "boolean", "description": "True by default."},
    "contact": {
        "type": "boolean",
        "description": "True by default; False lets bodies pass through each other.",
    },
    "others": {
        "enum": ["free", "locked"],
        "description": "free (default): position servos hold the pose, the rest is loose. locked: "
        "all joints but this one and those tied to it are bolted, a free base too.",
    },
    "settle": {
        **QUANTITY_SCHEMA,
        "description": "How long the robot is held before the stimulus, '0.5 s' by default.",
    },
}
"""Properties of a stimulus that both kinds share."""


@dataclass(frozen=True, slots=True)
class Drive:
    """A joint on the bench, at rest or settled under its hold.

    Attributes:
        model, data: what to step; the hold is in ``data.ctrl``.
        input: the control that takes the command, None where it acts on the joint as a force.
        hold: the command that holds, in ``command_unit``.
        at: index of the response in ``qpos`` or ``qvel``.
        dof: index of the joint in ``qvel``.
        command, response: modes.
    """

    joint: str
    model: mujoco.MjModel
    data: mujoco.MjData
    input: CommandInput | None
    hold: float
    at: int
    dof: int
    command: str
    response: str
    command_unit: str
    response_unit: str

    def apply(self, command: float) -> None:
        """Write ``command`` (hold included), in ``command_unit``, into ``data``."""
        if self.input is None:
            self.data.qfrc_applied[self.dof] = command
        else:
            self.data.ctrl[self.input.control] = self.input.scale * command

    def series(self, qpos: FloatArray, qvel: FloatArray) -> FloatArray:
        """The response out of states (..., nq) and (..., nv)."""
        return np.asarray((qpos if self.response == "position" else qvel)[..., self.at])


def prepare(golden: Golden, realization: Realization, extremes: tuple[float, float]) -> Drive:
    """Put the joint of ``golden.target`` on the bench and let it settle.

    Args:
        extremes: least and greatest command of the stimulus, relative to the hold.

    Raises:
        SpecError: no such joint or input, or a stimulus that leaves the control's or the
            joint's range.
        SimulationError: it diverges while it is held.
    """
    from pytest_twin.realization import simulate

    joint, kind = joint_of(golden, realization)
    item, command = _input(golden, realization)
    response = golden.target.get("response", "position" if command == "position" else "velocity")
    stimulus = golden.stimulus
    pose = resolve_pose(golden, realization, stimulus.get("pose", REFERENCE), "stimulus.pose")
    locked: list[str] = []
    if stimulus.get("others", "free") == "locked":
        tied = simulate.coupled_joints(realization, joint)
        locked = [name for name in realization.joints if name not in tied]
    model = simulate.bench(
        realization,
        gravity=stimulus.get("gravity", True),
        contact=stimulus.get("contact", True),
        locked=locked,
    )
    data = simulate.start(model, realization, pose.qpos)
    data.ctrl[:] = simulate.hold(model, data)
    hold = 0.0 if item is None else float(data.ctrl[item.control]) / item.scale
    settle = quantity(golden, "stimulus.settle", stimulus.get("settle", 0.5), "s")
    if not 0.0 <= settle <= 60.0:
        raise spec_error(
            golden, "stimulus.settle", "out of bounds", value=settle, unit="s", expected="0 to 60 s"
        )
    unit = _UNITS[command][kind]
    _check_range(golden, realization, item, (hold + extremes[0], hold + extremes[1]), unit)
    if settle > 0.0:
        simulate.simulate(model, data, simulate.steps_in(model, settle))
    dof = realization.joint_dof_index(joint)
    return Drive(
        joint=joint,
        model=model,
        data=data,
        input=item,
        hold=hold,
        at=realization.joint_qpos_index(joint) if response == "position" else dof,
        dof=dof,
        command=command,
        response=response,
        command_unit=unit,
        response_unit=_UNITS[response][kind],
    )


def command_unit(golden: Golden, realization: Realization) -> str:
    """SI unit of the command that the golden's joint takes; raises as ``prepare`` does."""
    _, kind = joint_of(golden, realization)
    return _UNITS[_input(golden, realization)[1]][kind]


def joint_of(golden: Golden, realization: Realization) -> tuple[str, str]:
    """The target's joint and its type, ``hinge`` or ``slide``."""
    types = {j: t for j, t in realization.structure.joint_type.items() if t in POSITION_UNIT}
    joint = known_name(
        golden, "target.joint", golden.target["joint"], types, "hinge or slide joint"
    )
    return joint, types[joint]


def _input(golden: Golden, realization: Realization) -> tuple[CommandInput | None, str]:
    from pytest_twin.realization.inputs import command_input, joint_inputs

    joint = golden.target["joint"]
    inputs = joint_inputs(realization.model, joint)
    mode = golden.target.get("command", inputs[0].mode if inputs else "effort")
    try:
        return command_input(realization.model, joint, mode), mode
    except SpecError as error:
        raise spec_error(
            golden, "target.command", error.problem, value=error.value, expected=error.expected
        ) from None


def _check_range(
    golden: Golden,
    realization: Realization,
    item: CommandInput | None,
    extremes: tuple[float, float],
    unit: str,
) -> None:
    model = realization.model
    ranges = []
    if item is not None and model.actuator_ctrllimited[item.control]:
        bounds = model.actuator_ctrlrange[item.control] / item.scale
        ranges.append(("the control's range", min(bounds), max(bounds)))
    joint = realization.joint_index(golden.target["joint"])
    if item is not None and item.mode == "position" and model.jnt_limited[joint]:
        ranges.append(("the joint's range", *model.jnt_range[joint]))
    for name, lower, upper in ranges:
        slack = 1e-9 * (upper - lower)
        for value in extremes:
            if not lower - slack <= value <= upper + slack:
                raise spec_error(
                    golden,
                    "stimulus.amplitude",
                    f"the stimulus leaves {name}",
                    value=f"{value:.6g}",
                    unit=unit,
                    expected=f"{lower:.6g} to {upper:.6g} {unit}",
                )


def drivable(realization: Realization) -> list[tuple[str, str]]:
    """(joint, command) of joints for first specs: those with an input, or all if none has.

    Followers of a coupling are left out.
    """
    import mujoco

    from pytest_twin.realization.inputs import joint_inputs

    model = realization.model
    followers = {
        str(model.joint(int(model.eq_obj1id[i])).name)
        for i in range(model.neq)
        if model.eq_type[i] == mujoco.mjtEq.mjEQ_JOINT and model.eq_active0[i]
    }
    types = realization.structure.joint_type
    joints = [j for j in realization.joints if types.get(j) in POSITION_UNIT and j not in followers]
    found: list[tuple[str, str]] = []
    for joint in joints:
        modes = [item.mode for item in joint_inputs(model, joint)]
        if modes and modes.count(modes[0]) == 1:
            found.append((joint, modes[0]))
    return found or [
        (joint, "effort")
        for joint in joints
        if not any(joint in driven for driven in realization.structure.actuator_joints.values())
    ]


def first_bench(realization: Realization, command: str) -> dict[str, Any]:
    """Pose and surroundings of a first spec: alone on the bench where nothing holds the rest,
    without contact where bodies overlap at the pose."""
    from pytest_twin.realization import simulate

    alone = command != "position" or "free" in realization.structure.joint_type.values()
    bench: dict[str, Any] = {"pose": simulate.first_pose(realization), "gravity": not alone}
    if alone:
        bench["others"] = "locked"
    if simulate.overlaps(realization, first_qpos(realization)):
        bench["contact"] = False
    return bench


def first_amplitude(realization: Realization, joint: str, command: str, duration: float) -> float:
    """A small command step, to the side with more room, in the command's unit, three digits.

    Position: 5 % of the range, at most 0.1 rad or 0.02 m. Velocity: what travels that far. Effort:
    what accelerates the joint that far in ``duration`` s, and dry friction.
    """
    import mujoco

    from pytest_twin.realization.inputs import command_input

    model = realization.model
    index = realization.joint_index(joint)
    travel = 0.1 if realization.structure.joint_type[joint] == "hinge" else 0.02
    data = mujoco.MjData(model)
    data.qpos[:] = first_qpos(realization)
    mujoco.mj_forward(model, data)
    sign = 1.0
    if model.jnt_limited[index]:
        lower, upper = (float(bound) for bound in model.jnt_range[index])
        travel = min(travel, 0.05 * (upper - lower))
        sign = 1.0 if data.qpos[model.jnt_qposadr[index]] <= 0.5 * (lower + upper) else -1.0
    amplitude = travel
    if command == "velocity":
        amplitude = travel / duration
    elif command == "effort":
        dof = int(model.jnt_dofadr[index])
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        amplitude = 2.0 * travel / duration**2 * float(inertia[dof, dof])
        amplitude += 1.5 * float(model.dof_frictionloss[dof])
    item = command_input(model, joint, command)  # type: ignore[arg-type]
    if item is not None and model.actuator_ctrllimited[item.control]:
        bounds = model.actuator_ctrlrange[item.control] / item.scale
        amplitude = min(amplitude, 0.1 * float(abs(bounds[1] - bounds[0])))
    return float(f"{sign * amplitude:.3g}")


def first_qpos(realization: Realization) -> FloatArray:
    """(nq,) of the pose that first specs start from."""
    from pytest_twin.realization import simulate

    pose = simulate.first_pose(realization)
    if isinstance(pose, str):
        model = realization.model
        return np.array(model.qpos0 if pose == REFERENCE else model.key(pose).qpos)
    return configuration(realization, pose["joints"])
