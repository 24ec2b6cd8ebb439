"""Convert recorded positions, efforts and commands to the joint side of the gears, in SI units.

The declaration is ``signals:`` of a ``twin.yaml``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import JointSeries
from pytest_twin.signals import ANGLES, NO_SIGNALS, Signals
from pytest_twin.trial.command_field import ChosenCommands


def positions_at_joints(
    names: Sequence[str],
    recorded: FloatArray,
    recorded_velocity: FloatArray | None,
    signals: Signals,
) -> tuple[FloatArray, FloatArray | None, list[str]]:
    """Return (n, joints) positions in rad or m, velocities, and a note for each conversion.

    Args:
        names: names of the joints in the model.
        recorded: (n, joints) positions in the declared units, on the declared side.
        recorded_velocity: (n, joints) the same per second, or None.
        signals: meaning of the recorded signals.

    Raises:
        ValueError: the motor of a joint is turned by another joint, which is not among the names.
    """
    position = np.empty_like(recorded)
    velocity = None if recorded_velocity is None else np.empty_like(recorded)
    notes = []
    for name in _dependents_last(names, signals):
        column = names.index(name)
        own = signals.of(name)
        factor = ANGLES[own.position.unit]
        if own.position.side == "motor":
            factor /= own.gear
            notes.append(f"{name}: motor position divided by its gear ratio {own.gear:g}")
        position[:, column] = recorded[:, column] * factor
        if velocity is not None and recorded_velocity is not None:
            velocity[:, column] = recorded_velocity[:, column] * factor
        if own.shared is not None and own.position.side == "motor":
            if own.shared.joint not in names:
                raise ValueError(f"{name}: its motor is also turned by {own.shared.joint}")
            other = names.index(own.shared.joint)
            # The zero of the other joint does not rotate this motor.
            zero = signals.of(own.shared.joint).zero
            position[:, column] -= own.shared.ratio * (position[:, other] - zero)
            if velocity is not None:
                velocity[:, column] -= own.shared.ratio * velocity[:, other]
        position[:, column] += own.zero
    return position, velocity, notes


def effort_factor(joint: str, signals: Signals) -> float | None:
    """Torque (force) at a joint per unit of its recorded effort.

    None if that is unknown: a current of unknown torque constant, or an amount without a sign.
    """
    own = signals.of(joint).effort
    if not own.signed or (own.quantity == "current" and own.constant is None):
        return None
    factor = 1.0 if own.constant is None else own.constant
    return factor * signals.of(joint).gear if own.side == "motor" else factor


def add_shared_efforts(names: Sequence[str], effort: FloatArray, signals: Signals) -> list[str]:
    """Add the torque of a motor that two joints turn to the other joint, in place.

    By virtual work, the motor's torque acts on both joints that rotate it.

    Returns:
        One note for each such motor.
    """
    notes = []
    for column, name in enumerate(names):
        shared = signals.of(name).shared
        if shared is not None and signals.of(name).effort.side == "motor" and shared.joint in names:
            effort[:, names.index(shared.joint)] += shared.ratio * effort[:, column]
            notes.append(
                f"{name}: its motor's torque acts on {shared.joint} too and is added there"
            )
    return notes


def states_at_joints(
    states: JointSeries, signals: Signals, path: Path
) -> tuple[JointSeries, list[str]]:
    """Return the states on the joint side, with a note for each conversion.

    An effort whose torque is unknown is left out.

    Args:
        states: states with the model's names.
        signals: meaning of the recorded signals.

    Raises:
        RecordingError: a joint is missing that turns the motor of another one.
    """
    if signals == NO_SIGNALS or states.position is None:
        return states, []
    for name, is_degree in zip(states.names, states.degrees, strict=False):
        if is_degree and signals.of(name).position.unit not in ("rad", "m"):
            raise RecordingError(
                f"two units of joint {name!r} are declared", path=path, where=states.topic,
                value=f"units: deg, and signals: unit: {signals.of(name).position.unit}",
                expected="one of them",
            )  # fmt: skip
    try:
        position, velocity, notes = positions_at_joints(
            states.names, np.asarray(states.position, dtype=np.float64), states.velocity, signals
        )
    except ValueError as error:
        raise without_other_joint(error, states.topic, path) from None
    effort = None
    if states.effort is not None:
        effort = np.array(states.effort, dtype=np.float64)
        for column, name in enumerate(states.names):
            factor = effort_factor(name, signals)
            effort[:, column] *= np.nan if factor is None else factor
            if factor is None:
                notes.append(f"{name}: its effort is no torque, and is not used")
        notes += add_shared_efforts(states.names, effort, signals)
        if not np.isfinite(effort).any():
            effort = None
    return replace(states, position=position, velocity=velocity, effort=effort), notes


def commands_at_joints(
    commands: ChosenCommands, signals: Signals, topic: str, path: Path
) -> ChosenCommands:
    """Return the commands on the joint side.

    Position commands have the unit and the side of the joint's positions, efforts those of its
    efforts.

    Args:
        commands: commands with the model's names.
        signals: meaning of the recorded signals.

    Raises:
        RecordingError: a command is no torque, or a joint is missing that turns the motor of
            another one.
    """
    if signals == NO_SIGNALS:
        return commands
    table = np.array(commands.table, dtype=np.float64)
    modes = np.array(commands.modes)
    try:
        for mode in ("position", "velocity"):
            columns = np.flatnonzero(modes == mode)
            names = [commands.joints[k] for k in columns]
            own = table[:, columns]
            position, velocity, _ = positions_at_joints(names, own, own, signals)
            table[:, columns] = position if mode == "position" or velocity is None else velocity
    except ValueError as error:
        raise without_other_joint(error, topic, path) from None
    columns = np.flatnonzero(modes == "effort")
    for column in columns:
        joint = commands.joints[column]
        factor = effort_factor(joint, signals)
        if factor is None:
            raise RecordingError(
                f"the commanded effort of joint {joint!r} is no torque",
                path=path,
                where=topic,
                value="a current of unknown torque constant, or an amount without a sign",
                expected=f"signals: joints: {joint}: effort: constant: in N*m per unit of the "
                "command",
            )
        table[:, column] *= factor
    efforts = table[:, columns]
    add_shared_efforts([commands.joints[k] for k in columns], efforts, signals)
    table[:, columns] = efforts
    return replace(commands, table=table)


def without_other_joint(error: ValueError, topic: str, path: Path) -> RecordingError:
    """Return the error of a recording without a joint that turns the motor of another one."""
    return RecordingError(
        f"{error}, which is not in the messages", path=path, where=topic,
        expected="both joints, or no shared_with: in signals: of twin.yaml",
    )  # fmt: skip


def _dependents_last(names: Sequence[str], signals: Signals) -> list[str]:
    """Order the joints so that a coupled joint follows the joint that moves its motor."""
    return sorted(names, key=lambda name: signals.of(name).shared is not None)
