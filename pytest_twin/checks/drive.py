"""One joint driven by one input, for the kinds ``step`` and ``frequency_response``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.checks.fields import (
    CONTACT_SCHEMA,
    EFFORT_UNIT,
    GRAVITY_SCHEMA,
    POSITION_UNIT,
    VELOCITY_UNIT,
    known_name,
    quantity,
    spec_error,
)
from pytest_twin.checks.poses import POSE_SCHEMA, REFERENCE, resolve_pose
from pytest_twin.checks.schemas import choice, quantity_field, table, text
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

CONTROL = "control"
"""Mode of a command that is an actuator's control, in the actuator's unit."""

TARGET_SCHEMA: Mapping[str, Any] = table(
    {
        "joint": text("Hinge or slide joint to test.", minLength=1),
        "actuator": text(
            "Actuator that drives the joint through a tendon. The amplitude is then in the unit "
            "of its control.",
            minLength=1,
        ),
        "command": choice(
            ["position", "velocity", "effort"],
            "Commanded quantity. Default: the mode of the joint's actuator. On a joint without an "
            "actuator, an effort is applied to the joint itself.",
        ),
        "response": choice(
            ["position", "velocity"],
            "Measured quantity. Default: position for a position command, else velocity.",
        ),
    },
    required=["joint"],
)
BENCH_SCHEMA: Mapping[str, Any] = {
    "pose": POSE_SCHEMA,
    "gravity": GRAVITY_SCHEMA,
    "contact": CONTACT_SCHEMA,
    "others": choice(
        ["free", "locked"],
        "free (default): position servos hold the pose, other joints can move. locked: all joints "
        "are fixed except the tested joint and those coupled to it; a free base is fixed too.",
    ),
    "settle": quantity_field(
        "Time under the holding command before the stimulus, up to 60 s. Default: '0.5 s'."
    ),
}
"""Schema properties of a stimulus that both kinds share."""


@dataclass(frozen=True, slots=True)
class Drive:
    """A prepared joint, at rest or settled under its holding command.

    Attributes:
        model, data: model and state to step; the holding command is in ``data.ctrl``.
        input: control for the command, None if the command is a force on the joint.
        hold: holding command, in ``command_unit``.
        at: index of the response in ``qpos`` or ``qvel``.
        dof: index of the joint in ``qvel``.
        command, response: modes. The command mode is ``control`` for an actuator that drives
            the joint through a tendon, with the actuator's unit.
        command_unit, response_unit: units of command and response.
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
        """Write ``command`` (holding command included), in ``command_unit``, to ``data``."""
        if self.input is None:
            self.data.qfrc_applied[self.dof] = command
        else:
            self.data.ctrl[self.input.control] = self.input.scale * command

    def series(self, qpos: FloatArray, qvel: FloatArray) -> FloatArray:
        """Return the (...) response from (..., nq) positions and (..., nv) velocities."""
        return np.asarray((qpos if self.response == "position" else qvel)[..., self.at])


def prepare(golden: Golden, realization: Realization, extremes: tuple[float, float]) -> Drive:
    """Prepare the joint of ``golden.target`` and let it settle.

    Args:
        extremes: smallest and largest command of the stimulus, relative to the holding
            command.

    Raises:
        SpecError: the joint or input is missing, or the stimulus exceeds the range of the
            control or of the joint.
        SimulationError: the simulation diverges while the joint is held.
    """
    from pytest_twin.realization import simulate

    joint, kind = joint_of(golden, realization)
    item, command = _input(golden, realization)
    unit = _unit(command, kind)
    position_like = item is not None and item.mode == "position"
    response = golden.target.get("response", "position" if position_like else "velocity")
    stimulus = golden.stimulus
    pose = resolve_pose(golden, realization, stimulus.get("pose", REFERENCE), "stimulus.pose")
    locked: list[str] = []
    if stimulus.get("others", "free") == "locked":
        tied = simulate.coupled_joints(realization, joint)
        locked = [name for name in realization.joints if name not in tied]
    model = simulate.prepare_model(
        realization,
        gravity=stimulus.get("gravity", True),
        contact=stimulus.get("contact", True),
        locked=locked,
    )
    data = simulate.initial_state(model, realization, pose.qpos)
    data.ctrl[:] = simulate.hold(model, data)
    hold = 0.0 if item is None else float(data.ctrl[item.control]) / item.scale
    settle = quantity(golden, "stimulus.settle", stimulus.get("settle", 0.5), "s")
    if not 0.0 <= settle <= 60.0:
        raise spec_error(
            golden, "stimulus.settle", "out of bounds", value=settle, unit="s", expected="0 to 60 s"
        )
    _check_range(golden, realization, item, (hold + extremes[0], hold + extremes[1]), unit)
    if settle > 0.0:
        simulate.run(realization, model, data, simulate.steps_in(model, settle))
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
    """Return the SI unit of the command to the golden's joint; raises as ``prepare``."""
    _, kind = joint_of(golden, realization)
    return _unit(_input(golden, realization)[1], kind)


def _unit(command: str, kind: str) -> str:
    return "1" if command == CONTROL else _UNITS[command][kind]


def joint_of(golden: Golden, realization: Realization) -> tuple[str, str]:
    """Return the target's joint and its type, ``hinge`` or ``slide``."""
    types = {j: t for j, t in realization.structure.joint_type.items() if t in POSITION_UNIT}
    joint = known_name(
        golden, "target.joint", golden.target["joint"], types, "hinge or slide joint"
    )
    return joint, types[joint]


def _input(golden: Golden, realization: Realization) -> tuple[CommandInput | None, str]:
    from pytest_twin.realization.inputs import command_input, joint_inputs

    joint = golden.target["joint"]
    if "actuator" in golden.target:
        return _tendon_input(golden, realization), CONTROL
    inputs = joint_inputs(realization.model, joint)
    mode = golden.target.get("command", inputs[0].mode if inputs else "effort")
    try:
        return command_input(realization.model, joint, mode), mode
    except SpecError as error:
        raise spec_error(
            golden, "target.command", error.problem, value=error.value, expected=error.expected
        ) from None


def _tendon_input(golden: Golden, realization: Realization) -> CommandInput:
    """Return the control of the actuator that drives the target's joint through a tendon."""
    from pytest_twin.realization import simulate
    from pytest_twin.realization.inputs import CommandInput

    joint = golden.target["joint"]
    actuator = known_name(
        golden, "target.actuator", golden.target["actuator"], realization.actuators, "actuator"
    )
    driven = simulate.driven_joints(realization, actuator)
    if joint not in driven:
        raise spec_error(
            golden,
            "target.actuator",
            f"this actuator does not drive joint {joint!r}",
            value=actuator,
            expected=f"one that does; it drives {', '.join(driven) or 'no joint'}",
        )
    if "command" in golden.target:
        raise spec_error(
            golden,
            "target.command",
            "a step of an actuator's control has no command mode",
            value=golden.target["command"],
            expected="target.actuator or target.command, not both",
        )
    index = realization.actuator_index(actuator)
    mode = simulate.command_kind(realization.model, index)
    return CommandInput(mode, realization.control_index(actuator), 1.0, index)


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
    through_tendon = "actuator" in golden.target
    if (
        item is not None
        and item.mode == "position"
        and model.jnt_limited[joint]
        and not through_tendon
    ):
        ranges.append(("the joint's range", *model.jnt_range[joint]))
    for name, lower, upper in ranges:
        slack = 1e-9 * (upper - lower)
        for value in extremes:
            if not lower - slack <= value <= upper + slack:
                raise spec_error(
                    golden,
                    "stimulus.amplitude",
                    f"the stimulus exceeds {name}",
                    value=f"{value:.6g}",
                    unit=unit,
                    expected=f"{lower:.6g} to {upper:.6g} {unit}",
                )
