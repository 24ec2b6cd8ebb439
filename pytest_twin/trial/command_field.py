"""Choose the field of command messages that is the command, for each joint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.dependency import Structure
from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import JointSeries
from pytest_twin.recording_options import COMMAND_MODES, CommandMode, RecordingOptions
from pytest_twin.trial.trial import Trial
from pytest_twin.words import list_names

_ACTUATORS: Mapping[str, str] = {
    "position": "a position servo",
    "velocity": "a velocity servo",
    "effort": "a motor",
}


@dataclass(frozen=True, slots=True)
class ChosenCommands:
    """Commands of the chosen fields.

    Attributes:
        joints: (j,) commanded joints.
        modes: (j,) chosen fields.
        table: (n, j) commands, rad, rad/s or N*m (m, m/s or N); NaN where a message does not
            contain the joint.
        never: joints that the topic names but no message commands.
        notes: fields that are not used, one line each.
        unstated: joints whose commands may be in any field by the recording, so that the model's
            actuator decided.
        others: joint -> field -> (n,) which messages fill it, for fields that are not used.
        left_out: joints whose commands no actuator takes.
    """

    joints: tuple[str, ...]
    modes: tuple[CommandMode, ...]
    table: FloatArray
    never: tuple[str, ...]
    notes: tuple[str, ...]
    unstated: frozenset[str] = frozenset()
    others: Mapping[str, Mapping[CommandMode, NDArray[np.bool_]]] = field(default_factory=dict)
    left_out: frozenset[str] = frozenset()


def choose_command_fields(
    series: JointSeries,
    structure: Structure | None,
    options: RecordingOptions,
    path: Path,
) -> ChosenCommands:
    """Choose the command field of each joint.

    The choice is the declared ``command_mode``, or the only filled field. Of several filled fields,
    it is the one that the model's actuator takes as input, or the only one that is not always zero.
    Joints without an actuator that takes their commands are left out, if other joints have one.

    Args:
        series: series of the command topic, with the model's joint names.
        structure: structure of the model; None without a model.
        options: options that a user declared.
        path: path of the recording, for errors.

    Raises:
        RecordingError: no field is filled, or several and none can be chosen; a declared field is
            empty; a declared joint is not commanded.
    """
    joints: list[str] = []
    modes: list[CommandMode] = []
    columns: list[NDArray[np.float64]] = []
    never: list[str] = []
    unstated: set[str] = set()
    others: dict[str, Mapping[CommandMode, NDArray[np.bool_]]] = {}
    unused: dict[tuple[CommandMode, tuple[CommandMode, ...], str], list[str]] = {}
    if isinstance(options.command_mode, Mapping):
        for joint in options.command_mode:
            if joint not in series.names:
                raise RecordingError(
                    "command_mode names a joint that is not commanded",
                    path=path, where=series.topic, value=joint, expected=list_names(series.names),
                )  # fmt: skip
    assumed: dict[tuple[CommandMode, str], list[str]] = {}
    inputs = {} if structure is None else structure.joint_inputs
    unfit = {} if structure is None else _fields_without_actuator(series, structure, options)
    for column, joint in enumerate(series.names):
        filled = _filled_modes(series, column)
        asked = options.mode_of(joint)
        if asked is not None and asked not in filled and (filled or options.command_mode == asked):
            if not filled:
                never.append(joint)
                continue
            raise RecordingError(
                f"{asked} commands of joint {joint!r} are empty",
                path=path, where=series.topic, value=" and ".join(filled) + " filled",
                expected=f"command_mode: {filled[0]}",
            )  # fmt: skip
        if not filled:
            never.append(joint)
            continue
        takes = tuple(inputs.get(joint, ()))
        if joint in unfit:
            continue
        mode, why = (
            (asked, "as declared") if asked else _chosen_modes(series, column, filled, takes)
        )
        if mode is None:
            raise _ambiguous_field(series.topic, joint, filled, takes, path)
        tables = _exclusive_fields(series, column, filled)
        joints.append(joint)
        modes.append(mode)
        columns.append(tables[mode])
        others[joint] = {name: ~np.isnan(tables[name]) for name in filled if name != mode}
        if asked is None and len(filled) > 1 and series.has_any_quantity(column):
            unstated.add(joint)
        if series.has_any_quantity(column):
            if asked is None:
                assumed.setdefault((mode, why), []).append(joint)
            continue
        used = {mode, "velocity"} if series.from_trajectories and mode == "position" else {mode}
        rest = tuple(name for name in filled if name not in used)
        if rest:
            unused.setdefault((mode, rest, why), []).append(joint)
    if not joints:
        raise RecordingError(
            "no command has a value",
            path=path,
            where=series.topic,
            value="position, velocity and effort are empty",
            expected="the field that the controller mode uses",
        )
    notes = [
        f"{series.topic}: {mode} commands count at {list_names(names)}, {why}; not used: "
        + " and ".join(rest)
        for (mode, rest, why), names in unused.items()
    ]
    notes += [
        f"{series.topic}: does not say whether it holds positions, velocities or efforts; taken as "
        f"{mode} commands at {list_names(names)}, {why} (--command-mode, or command_mode: in "
        "twin.yaml, says otherwise)"
        for (mode, why), names in assumed.items()
    ]
    notes += [
        f"{series.topic}: {' and '.join(fields)} commands of {joint!r} are not used, {why}"
        for joint, (fields, why) in unfit.items()
    ]
    return ChosenCommands(
        tuple(joints), tuple(modes), np.stack(columns, axis=1), tuple(never), tuple(notes),
        frozenset(unstated), others, frozenset(unfit),
    )  # fmt: skip


def refuse_unfit_modes(structure: Structure, trial: Trial) -> None:
    """Check that the model's actuators take the commands of a trial.

    Raises:
        RecordingError: they do not.
    """
    for joint, mode in zip(trial.command_joints, trial.command_modes, strict=True):
        takes = structure.joint_inputs.get(joint, ())
        if mode in takes or (mode == "effort" and not takes):
            continue
        has = f"its actuator takes {' and '.join(takes)}" if takes else "it has no actuator"
        raise RecordingError(
            f"no actuator of joint {joint!r} takes {mode} commands",
            path=trial.path,
            value=f"{mode} commands; {has}",
            expected=f"a model with {_ACTUATORS[mode]} there, or the topic or field of other "
            "commands (--topics, --command-mode)",
        )


def _filled_modes(series: JointSeries, column: int) -> tuple[CommandMode, ...]:
    return tuple(
        name
        for name in COMMAND_MODES
        if (table := getattr(series, name)) is not None and not np.isnan(table[:, column]).all()
    )


def _exclusive_fields(
    series: JointSeries, column: int, filled: Sequence[CommandMode]
) -> dict[CommandMode, FloatArray]:
    """Field -> (n,) values of one joint, NaN where only another field commands it.

    Where two fields are never different from zero together, and each is at some time, a zero means
    that the other field is the command.
    """
    found: dict[CommandMode, FloatArray] = {
        name: np.array(getattr(series, name)[:, column], dtype=np.float64) for name in filled
    }
    if len(filled) != 2:
        return found
    one, two = (np.nan_to_num(values) != 0.0 for values in found.values())
    if one.any() and two.any() and not (one & two).any():
        first, second = filled
        found[first][two] = np.nan
        found[second][one] = np.nan
    return found


def _fields_without_actuator(
    series: JointSeries, structure: Structure, options: RecordingOptions
) -> dict[str, tuple[tuple[CommandMode, ...], str]]:
    """Joint -> filled command fields and why none is used: no actuator of the joint takes it.

    The result is empty if that is so for all joints: then the model has other actuators, which is
    reported when it is simulated.
    """
    by_joint = isinstance(options.command_mode, Mapping)
    found: dict[str, tuple[tuple[CommandMode, ...], str]] = {}
    others = 0
    for column, joint in enumerate(series.names):
        filled, takes = _filled_modes(series, column), structure.joint_inputs.get(joint, ())
        asked = options.mode_of(joint)
        if not filled:
            continue
        usable = bool(takes and (asked or set(filled) & set(takes)))
        others += usable
        if usable or (by_joint and asked):
            continue
        if takes:
            found[joint] = (
                filled,
                f"the model has {_ACTUATORS[takes[0]]} there, which is taken to hold the joint",
            )
        elif joint in structure.leaders or not _acts_as_effort(series, column, filled, asked):
            found[joint] = (filled, _why_without_actuator(structure, joint))
        else:
            others += 1
    return found if others else {}


def _acts_as_effort(
    series: JointSeries,
    column: int,
    filled: tuple[CommandMode, ...],
    asked: CommandMode | None,
) -> bool:
    """Whether the commands of a joint without an actuator are efforts, which act on the joint."""
    return (asked or _chosen_modes(series, column, filled, ())[0]) == "effort"


def _why_without_actuator(structure: Structure, joint: str) -> str:
    if joint in structure.leaders:
        return f"in the model it has no actuator: it follows {structure.leaders[joint]!r}"
    drivers = [name for name, driven in structure.actuator_joints.items() if joint in driven]
    if drivers:
        return (
            f"in the model it has no actuator of its own: {drivers[0]!r} moves it with other "
            "joints, and its command is not recorded"
        )
    return "in the model it has no actuator and moves freely"


def _chosen_modes(
    series: JointSeries, column: int, filled: tuple[CommandMode, ...], takes: Sequence[str]
) -> tuple[CommandMode | None, str]:
    """The chosen field and the reason; None if none can be chosen."""
    if len(filled) == 1:
        return filled[0], ""
    fitting = [name for name in filled if name in takes]
    if fitting:
        # A servo with inputs for position and velocity follows the position.
        return fitting[0], f"the model has {_ACTUATORS[fitting[0]]} there"
    if series.from_trajectories and "position" in filled:
        return "position", "velocities of a trajectory are the slope of its positions"
    if not takes and "effort" in filled and _is_nonzero(series, "effort", column):
        others = [n for n in filled if n != "effort" and _is_nonzero(series, n, column)]
        if not others:
            return "effort", "the others are zero"
    moving = [name for name in filled if _is_nonzero(series, name, column)]
    if len(moving) == 1:
        return moving[0], "the others are zero"
    return None, ""


def _is_nonzero(series: JointSeries, field: str, column: int) -> bool:
    table: FloatArray = getattr(series, field)
    return bool(np.nan_to_num(table[:, column]).any())


def _ambiguous_field(
    topic: str, joint: str, filled: Sequence[str], takes: Sequence[str], path: Path
) -> RecordingError:
    has = f"its actuators take {' and '.join(takes)}" if takes else "no actuator of it says which"
    return RecordingError(
        f"commands of joint {joint!r} fill {' and '.join(filled)}, and {has}",
        path=path,
        where=topic,
        expected=f"--command-mode {joint}={filled[0]}, or 'command_mode:' in twin.yaml",
    )
