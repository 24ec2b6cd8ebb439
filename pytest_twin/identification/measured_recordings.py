"""Convert recorded states to joint positions and joint efforts, by the stated signals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.sensing import EffortScale
from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import JointSeries, Recording
from pytest_twin.identification.known_effects import KnownEfforts, known_efforts
from pytest_twin.realization import Realization
from pytest_twin.realization.driven_base import DrivenBase, drive_base, refuse_contact
from pytest_twin.realization.encoders import Encoders, calibration_of
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.signals import Signals
from pytest_twin.trial import recordings_at
from pytest_twin.trial.base_motion import base_motion
from pytest_twin.trial.changed_meaning import meaning_changes
from pytest_twin.trial.command_field import choose_command_fields
from pytest_twin.trial.dropouts import without_dropouts
from pytest_twin.trial.floating_base import check_floating_base, is_floating
from pytest_twin.trial.joint_side import (
    add_shared_efforts,
    effort_factor,
    positions_at_joints,
    without_other_joint,
)
from pytest_twin.trial.joints import in_model_names, metres_of_slides, name_by_actuators
from pytest_twin.trial.repeated_states import own_samples
from pytest_twin.trial.roles import refuse_final
from pytest_twin.trial.stream_checks import (
    check_copies,
    refuse_backward_stamps,
    refuse_other_scale,
)
from pytest_twin.trial.table import kept_commands, stamp_order
from pytest_twin.trial.unwrap_joints import RecordedMotion, unwrap_joints

_FEWEST = 50
"""Fewest states of a recording for differentiation."""
_NO_SENSOR = 0.5
"""Fraction of efforts that are exactly 0 above which they are not measured. A sensor has noise."""
_CLIPPED = 0.002
"""Fraction of states at the largest effort, three in a row, above which it is a limit."""
_GAP = 5.0
"""Ratio of an interval to the median interval above which the recording is cut there."""
_SHORT_GAP = 0.01
"""Interval, s, up to which a recording is never cut: within it, a motion of 2 Hz leaves a straight
line by 0.2 % of its amplitude. Logs of 1 kHz have such intervals all over."""

_ENDS_OF_POSES = 15.0
"""Intervals between poses of the base, at both ends, in which its acceleration is not known."""

AN_AMOUNT = (
    "effort never changes its sign: an amount and no torque; it is not used. Record the signed "
    "current, or identify from commands and positions alone"
)
_MOVED = 0.02
"""Standard deviation of positions, rad or m, below which velocities are not compared with them: of
servos these are often coarse."""
_ALIKE, _OTHER_UNIT = 0.9, 0.2
"""Smallest correlation of a velocity's integral with the position, and largest deviation of their
ratio from 1, for a velocity that agrees with the positions."""
_SPEEDS = {"deg/s": 180.0 / np.pi, "revolutions per minute": 30.0 / np.pi}
"""Unit of velocities -> its number for 1 rad/s."""


@dataclass(frozen=True)
class MeasuredRecording:
    """One recording without gaps, on the joint side of the gears.

    Attributes:
        start: time from the recording's first state, s.
        stamp: stamp of the recording's first state, ns; the time of day if its clock has it.
        joints: names in the model.
        time: (n,) s, increasing.
        position: (n, joints) rad or m.
        velocity: (n, joints) rad/s or m/s as recorded, or None.
        effort: (n, joints) N*m or N; in the recorded unit where ``unscaled``; NaN where there is no
            sensor.
        unscaled: (joints,) True if the effort is a current with unknown torque constant.
        limit: (joints,) effort at which the drive saturates, else infinity.
        command: (n, joints) position commands that hold at the states, of the encoders, rad or m;
            NaN where there is none; None without any.
        known: efforts of the given model along the motion, beside those of its regressor; None
            for none.
        base: floating base that moves along its recorded pose; None if none was recorded.
        filter_cutoff: lowest cutoff, Hz, of the filters that ``signals:`` states for these joints;
            None where it states none.
    """

    path: Path
    start: float
    joints: tuple[str, ...]
    time: FloatArray
    position: FloatArray
    velocity: FloatArray | None
    effort: FloatArray
    unscaled: NDArray[np.bool_]
    limit: FloatArray
    metadata: Mapping[str, str]
    notes: tuple[str, ...] = ()
    command: FloatArray | None = None
    known: KnownEfforts | None = None
    base: DrivenBase | None = None
    filter_cutoff: float | None = None
    stamp: int = 0

    @property
    def rate(self) -> float:
        """States per second."""
        return float(1.0 / np.median(np.diff(self.time)))


@dataclass(frozen=True)
class MeasuredRecordings:
    """Recordings by their role.

    Attributes:
        fit: recordings for fitting.
        held_out: recordings for testing only.
    """

    fit: tuple[MeasuredRecording, ...]
    held_out: tuple[MeasuredRecording, ...]
    notes: tuple[str, ...] = field(default=())


def read_measured(
    path: Path,
    realization: Realization,
    topics: Mapping[str, str],
    options: RecordingOptions,
    signals: Signals,
) -> list[MeasuredRecording]:
    """Read the states of a recording, cut at its gaps.

    Raises:
        RecordingError: there are no states or positions, or too few.
        TwinError: the recording cannot be read.
    """
    found = []
    for recording in recordings_at(path, topics, replace(options, signals=signals)):
        refuse_final(recording.metadata, path, "an identification")
        recording = without_dropouts(recording)
        series, named = _commands_or_states(recording, "state", realization, topics, options)
        refuse_backward_stamps(series, recording.path)
        loose = check_floating_base(
            realization.structure, series.names, recording.path,
            has_pose=recording.base is not None,
        )  # fmt: skip
        commanded, notes = _commands_at_states(recording, series, realization, topics, options)
        at_joints = _at_joints(series, commanded, recording, signals)
        whole = _in_model(
            _checked_and_unwrapped(at_joints, series.topic, realization, signals), realization
        )
        whole, moves = _with_base(whole, recording, series, realization)
        before = (*recording.notes, *named, *moves)
        found += _stretches(replace(whole, notes=(*before, *whole.notes, *notes, *loose)))
    return found


def _with_base(
    read: MeasuredRecording, recording: Recording, series: JointSeries, realization: Realization
) -> tuple[MeasuredRecording, tuple[str, ...]]:
    """Return the recording with the motion of its floating base, and notes on it.

    Raises:
        RecordingError: the poses do not cover the recording, or the robot touches something.
    """
    if recording.base is None or not is_floating(realization.structure, read.joints):
        return read, ()
    start = int(series.stamp[stamp_order(series.stamp)][0])
    motion = base_motion(recording.base, start, float(read.time[-1]), recording.path)
    joints = [realization.joint_index(joint) for joint in read.joints]
    model, base, notes = drive_base(realization.model, joints, motion, realization.path)
    refuse_contact(model, base, joints, read.time, read.position, recording.path)
    margin = _ENDS_OF_POSES * float(np.median(np.diff(motion.time)))
    inside = (read.time >= motion.time[0] + margin) & (read.time <= motion.time[-1] - margin)
    return replace(_rows_of(read, inside), base=base), (motion.note(), *notes)


def _rows_of(
    read: MeasuredRecording, rows: NDArray[np.bool_] | NDArray[np.intp]
) -> MeasuredRecording:
    """Return some states of a recording, whose times stay as they are."""
    return replace(
        read,
        time=read.time[rows],
        position=read.position[rows],
        velocity=None if read.velocity is None else read.velocity[rows],
        effort=read.effort[rows],
        command=None if read.command is None else read.command[rows],
    )


def _commands_or_states(
    recording: Recording,
    role: str,
    realization: Realization,
    topics: Mapping[str, str],
    options: RecordingOptions,
) -> tuple[JointSeries, list[str]]:
    """Return the topic of a role with the model's names, and notes on joints that are left out."""
    series = recording.series.get(role)
    if series is None or not len(series.stamp):
        raise RecordingError(
            "no joint states",
            path=recording.path,
            where=topics.get("state"),
            expected="positions and efforts of the joints; map the topic in twin.yaml or by "
            "--topics state=/x",
        )
    series, placed = name_by_actuators(
        series, options.joints, realization.structure.actuator_joints
    )
    named, notes = in_model_names(series, options.joints, realization.joints, recording.path)
    named, in_metres = metres_of_slides(named, realization.structure.joint_type)
    if named.position is None and role == "state":
        raise RecordingError(
            "no state has positions",
            path=recording.path,
            where=series.topic,
            expected="positions of the joints, rad or m",
        )
    return named, [*placed, *notes, *in_metres]


def _commands_at_states(
    recording: Recording,
    states: JointSeries,
    realization: Realization,
    topics: Mapping[str, str],
    options: RecordingOptions,
) -> tuple[dict[str, FloatArray], list[str]]:
    """Return command mode -> (n, joints) commands at the stamps of the states, NaN without command.

    If efforts were measured, unreadable commands are left out with a note.
    """
    if "command" not in recording.series:
        return {}, []
    try:
        commands, _ = _commands_or_states(recording, "command", realization, topics, options)
        commanded = choose_command_fields(commands, realization.structure, options, recording.path)
    except RecordingError as error:
        if not _measures(states):
            raise
        return {}, [f"commands are not used: {error.problem}"]
    order = stamp_order(commands.stamp)
    table = kept_commands(np.asarray(commanded.table, dtype=np.float64)[order])
    at = np.searchsorted(commands.stamp[order], states.stamp, side="right") - 1
    found: dict[str, FloatArray] = {}
    for column, name in enumerate(states.names):
        if name in commanded.joints:
            own = commanded.joints.index(name)
            mode = found.setdefault(
                commanded.modes[own], np.full((len(states.stamp), len(states.names)), np.nan)
            )
            mode[:, column] = table[np.maximum(at, 0), own]
    return found, []


def _measures(states: JointSeries) -> bool:
    return states.effort is not None and bool(np.isfinite(states.effort).any())


def _at_joints(
    series: JointSeries,
    commanded: Mapping[str, FloatArray],
    recording: Recording,
    signals: Signals,
) -> MeasuredRecording:
    assert series.position is not None
    order = stamp_order(series.stamp)
    stamp = series.stamp[order]
    samples = own_samples(stamp, {
        "position": series.position[order],
        "velocity": None if series.velocity is None else series.velocity[order],
        "effort": None if series.effort is None else series.effort[order],
    })  # fmt: skip
    repeated = samples.note(series.topic, len(stamp))
    order, stamp = order[samples.rows], stamp[samples.rows]
    once = np.append(True, np.diff(stamp) > 0)
    order, stamp = order[once], stamp[once]
    time = np.asarray((stamp - stamp[0]) * 1e-9, dtype=np.float64)
    raw = np.array(series.position[order], dtype=np.float64)
    seen = np.isfinite(raw).mean(axis=0) > 0.5
    names = tuple(n for n, use in zip(series.names, seen, strict=True) if use)
    raw = raw[:, seen]
    speed = None if series.velocity is None else np.array(series.velocity[order])[:, seen]
    measures = _measures(series)
    efforts = series.effort if measures else commanded.get("effort")
    effort = (
        np.full_like(raw, np.nan)
        if efforts is None
        else np.array(efforts[order], dtype=np.float64)[:, seen]
    )
    try:
        position, velocity, notes = positions_at_joints(names, raw, speed, signals)
    except ValueError as error:
        raise without_other_joint(error, series.topic, recording.path) from None
    effort, unscaled, limit, said = _efforts(names, effort, signals)
    if efforts is not None and not measures:
        said.insert(
            0, "no effort is measured: the commanded effort is taken as the drive's (inferred)"
        )
    whole = np.isfinite(position).all(axis=1)
    lost = int((~whole).sum())
    if lost:
        notes.append(f"{lost} states without the position of every joint left out")
    command = commanded.get("position")
    if command is not None:
        at_motors = command[order][:, seen][whole]
        command, _, _ = positions_at_joints(names, at_motors, None, signals)
    velocity_there = None if velocity is None else velocity[whole]
    return MeasuredRecording(
        path=recording.path,
        start=0.0,
        joints=names,
        time=time[whole],
        position=position[whole],
        velocity=velocity_there,
        effort=effort[whole],
        unscaled=unscaled,
        limit=limit,
        metadata=dict(recording.metadata),
        notes=(
            *repeated,
            *notes,
            *said,
            *velocity_notes(names, time[whole], position[whole], velocity_there),
        ),
        command=command,
        filter_cutoff=min(
            (cutoff for name in names if (cutoff := signals.of(name).filter_cutoff) is not None),
            default=None,
        ),
        stamp=int(stamp[0]),
    )


def _checked_and_unwrapped(
    read: MeasuredRecording, topic: str, realization: Realization, signals: Signals
) -> MeasuredRecording:
    """Return the recording with all turns of its revolute joints.

    Raises:
        RecordingError: the number of turns cannot be determined, or positions are copies of their
            commands or have another unit.
    """
    position = read.position.copy()
    command = np.empty((0, 0)) if read.command is None else read.command.copy()
    columns = {} if read.command is None else {joint: k for k, joint in enumerate(read.joints)}
    motion = RecordedMotion(
        read.path, topic, read.joints, read.time, position,
        read.time[: len(command)], command, columns,
    )  # fmt: skip
    refuse_other_scale(motion, realization.structure.joint_range)
    notes = unwrap_joints(motion, realization.structure, signals)
    _, copied = check_copies(motion)
    notes += copied
    notes += meaning_changes(motion)
    if not notes:
        return read
    return replace(
        read,
        position=position,
        command=None if read.command is None else command,
        notes=(*read.notes, *notes),
    )


def _in_model(read: MeasuredRecording, realization: Realization) -> MeasuredRecording:
    """Return the recording in the model's joint coordinates.

    The twin's calibration and the sensor effects of an earlier diagnosis are applied.
    """
    encoders = Encoders.of(calibration_of(realization), read.joints)
    known = known_efforts(realization, read.joints)
    position, velocity = known.true_motion(
        encoders.model_position(read.position),
        None if read.velocity is None else encoders.model_velocity(read.velocity),
    )
    effort = known.true_effort(encoders.signed(read.effort))
    # Where an earlier identification found the constant of a current, it is a torque now.
    scaled = {one.joint for one in known.effects if one.effect == EffortScale.id}
    unscaled = read.unscaled & np.array([joint not in scaled for joint in read.joints])
    return replace(
        read, position=position, velocity=velocity, effort=effort, known=known, unscaled=unscaled
    )


def velocity_notes(
    names: Sequence[str], time: FloatArray, position: FloatArray, velocity: FloatArray | None
) -> list[str]:
    """Return notes on velocities that are missing, or that the positions contradict.

    No velocity is used: positions are differentiated. The integral of a recorded velocity is
    compared with the position, because noise hardly changes it.

    Args:
        time: (n,) s.
        position, velocity: (n, joints) rad and rad/s, or m and m/s; velocity None without any.
    """
    known = np.zeros(len(names), dtype=bool)
    if velocity is not None:
        known = np.isfinite(velocity).all(axis=0) & (velocity != 0.0).any(axis=0)
    notes = []
    missing = [name for name, seen in zip(names, known, strict=True) if not seen]
    if missing:
        whose = "" if len(missing) == len(names) else f" of {', '.join(missing)}"
        notes.append(f"no velocity{whose} is recorded: positions are differentiated")
    for k, joint in enumerate(names):
        if not known[k]:
            continue
        assert velocity is not None
        moved = position[:, k] - position[0, k]
        if len(time) < _FEWEST or float(moved.std()) < _MOVED:
            continue
        steps = np.diff(time) * 0.5 * (velocity[1:, k] + velocity[:-1, k])
        summed = np.concatenate([[0.0], np.cumsum(steps)])
        trend = np.column_stack([np.ones(len(time)), time])
        own, theirs = (
            x - trend @ np.linalg.lstsq(trend, x, rcond=None)[0] for x in (moved, summed)
        )
        factor = float(own @ theirs) / max(float(own @ own), 1e-300)
        alike = (
            abs(factor) * float(np.linalg.norm(own)) / max(float(np.linalg.norm(theirs)), 1e-300)
        )
        if alike < _ALIKE:
            notes.append(
                f"{joint}: the recorded velocity does not follow the positions; it is not used"
            )
        elif abs(factor - 1.0) > _OTHER_UNIT:
            unit = next((u for u, size in _SPEEDS.items() if abs(factor / size - 1.0) < 0.1), "")
            said = f"it seems to be in {unit}" if unit else "its unit, side or sign is wrong"
            notes.append(
                f"{joint}: the recorded velocity is {factor:.3g} times the change of the "
                f"positions: {said}; it is not used"
            )
    return notes


def _efforts(
    names: Sequence[str], effort: FloatArray, signals: Signals
) -> tuple[FloatArray, NDArray[np.bool_], FloatArray, list[str]]:
    """Compute joint efforts; efforts that are no measurement become NaN, with a note."""
    effort = effort.copy()
    unscaled = np.zeros(len(names), dtype=bool)
    limit = np.full(len(names), np.inf)
    notes = []
    for column, name in enumerate(names):
        own = signals.of(name).effort
        values = effort[:, column]
        known = values[np.isfinite(values)]
        zeros = float(np.mean(known == 0.0)) if len(known) else 1.0
        if zeros > _NO_SENSOR:
            if len(known):
                share = "throughout" if zeros == 1.0 else f"in {100 * zeros:.0f} % of the states"
                notes.append(f"{name}: effort reads 0 {share}: no sensor, its effort is unknown")
            effort[:, column] = np.nan
            continue
        if not own.signed:
            notes.append(f"{name}: {AN_AMOUNT}")
            effort[:, column] = np.nan
            continue
        top = saturation_level(values) if own.limit is None else own.limit
        if top is not None and own.limit is None:
            notes.append(
                f"{name}: effort is repeatedly {top:.4g}: the drive is at its limit or the signal "
                "is clipped; these samples are left out"
            )
        factor = effort_factor(name, signals)
        if factor is None:
            unscaled[column] = True
            factor = signals.of(name).gear if own.side == "motor" else 1.0
            notes.append(
                f"{name}: effort is a current of unknown torque constant: the constant is "
                "identified against the model's inertia, and no inertia from this joint"
            )
        effort[:, column] = values * factor
        if top is not None:
            limit[column] = abs(top * factor)
    notes += add_shared_efforts(names, effort, signals)
    return effort, unscaled, limit, notes


def saturation_level(values: FloatArray) -> float | None:
    """Return the magnitude at which efforts saturate, several samples in a row; None otherwise."""
    size = np.abs(values[np.isfinite(values)])
    top = float(size.max(initial=0.0))
    at_top = size >= top * (1.0 - 1e-9)
    in_a_row = at_top[2:] & at_top[1:-1] & at_top[:-2]
    return top if top > 0.0 and in_a_row.mean() > _CLIPPED else None


def may_be_an_amount(effort: FloatArray) -> bool:
    """Whether efforts (n,) may be magnitudes only: never negative, and often zero.

    A torque that only carries weight may look like this too.
    """
    known = effort[np.isfinite(effort)]
    if not len(known) or known.min() < 0.0:
        return False
    return bool(np.quantile(known, 0.05) < 0.1 * np.quantile(known, 0.95))


def _stretches(whole: MeasuredRecording) -> list[MeasuredRecording]:

    if len(whole.time) < _FEWEST:
        raise RecordingError(
            "too few states to differentiate",
            path=whole.path,
            value=len(whole.time),
            expected=f"at least {_FEWEST}",
        )
    step = np.diff(whole.time)
    cuts = np.flatnonzero(step > max(_GAP * float(np.median(step)), _SHORT_GAP)) + 1
    found = []
    for some in np.split(np.arange(len(whole.time)), cuts):
        if len(some) < _FEWEST:
            continue
        part = _rows_of(whole, some)
        found.append(replace(part, start=float(part.time[0]), time=part.time - part.time[0]))
    return found
