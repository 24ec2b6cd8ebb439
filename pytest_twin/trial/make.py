"""Convert a recording to trials: joint names, clock, table, command fields, missing data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.dependency import Structure
from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import JointSeries, Recording
from pytest_twin.formats.recordings.candidates import what_to_do
from pytest_twin.recording_options import (
    COMMAND_BETWEEN,
    COMMAND_MODES,
    NO_OPTIONS,
    CommandBetween,
    RecordingOptions,
)
from pytest_twin.signals import Signals
from pytest_twin.trial.base_motion import base_motion
from pytest_twin.trial.changed_meaning import meaning_changes
from pytest_twin.trial.clock import TimedMessages, on_one_clock
from pytest_twin.trial.column_mistakes import column_mistakes
from pytest_twin.trial.command_field import ChosenCommands, choose_command_fields
from pytest_twin.trial.command_span import (
    MOVES,
    OtherMode,
    other_modes,
    within_commands,
    without_other_modes,
)
from pytest_twin.trial.controller_period import held_by_controller, period_note, period_of
from pytest_twin.trial.dropouts import without_dropouts
from pytest_twin.trial.floating_base import check_floating_base, is_floating
from pytest_twin.trial.gaps import stretches
from pytest_twin.trial.joint_side import commands_at_joints, states_at_joints
from pytest_twin.trial.joints import in_model_names, metres_of_slides, name_by_actuators
from pytest_twin.trial.recording_checks import RecordingChecks
from pytest_twin.trial.repeated_states import own_samples
from pytest_twin.trial.stream_checks import (
    check_copies,
    refuse_backward_stamps,
    refuse_other_scale,
)
from pytest_twin.trial.table import (
    StateRows,
    kept_commands,
    last_known,
    merge_states,
    stamp_order,
)
from pytest_twin.trial.trial import Mark, Trial, stamps_of_densest_joint
from pytest_twin.trial.unwrap_joints import RecordedMotion, unwrap_joints
from pytest_twin.words import list_names

# Texts of readers about stamps.
_STAMP_TEXTS = ("stamps go back", "stamps occur twice", "header.stamp")
# A joint that is in fewer of a topic's messages than this share comes in messages of its own.
_SEPARATE_SHARE = 0.8
# Share of samples with the stamp of the one before up to which single messages are marked only.
_FEW_TWICE = 0.01


def make_trials(
    recording: Recording,
    structure: Structure | None = None,
    options: RecordingOptions = NO_OPTIONS,
    *,
    compares_motion: bool = True,
) -> list[Trial]:
    """Convert a recording to trials: one, or one for each part between gaps of both topics.

    Args:
        structure: structure of the model, for joints, ranges and actuators; None without a model.
        options: options that a user declared.
        compares_motion: whether the recorded motion is compared with the model's. If only commands
            and the first state are used, commands may be copies of the states.

    Raises:
        RecordingError: no states or commands, no positions, an infinite value, no command field
            that can be chosen, no overlap in time, no joint of the model, or positions in another
            unit than the model's.
    """
    return [
        within_commands(part)
        for trial in _whole(recording, structure, options, compares_motion=compares_motion)
        for part in stretches(trial)
    ]


def make_trial(
    recording: Recording,
    structure: Structure | None = None,
    options: RecordingOptions = NO_OPTIONS,
) -> Trial:
    """Convert a recording to one trial, which may contain gaps; :func:`make_trials` splits there.

    Raises:
        RecordingError: as :func:`make_trials`, or the clock steps back and splits the recording.
    """
    trials = _whole(recording, structure, options)
    if len(trials) > 1:
        raise RecordingError(
            "the clock steps back: no single trial", path=recording.path,
            value=f"{len(trials)} parts", expected="one clock",
        )  # fmt: skip
    return trials[0]


def _whole(
    recording: Recording,
    structure: Structure | None,
    options: RecordingOptions,
    *,
    compares_motion: bool = True,
) -> list[Trial]:
    recording = without_dropouts(recording)
    joints = None if structure is None else structure.joint_type.keys()
    notes: list[str] = list(recording.notes)
    topics = []
    unnamed: set[str] = set()
    for role in ("state", "command"):
        series = _series(recording, role)
        if structure is not None:
            series, placed = name_by_actuators(series, options.joints, structure.actuator_joints)
            notes += placed
            unnamed |= {role} if placed else set()
        series, said = in_model_names(series, options.joints, joints, recording.path)
        if structure is not None:
            series, metres = metres_of_slides(series, structure.joint_type)
            notes += metres
        refuse_backward_stamps(series, recording.path)
        topics.append(series)
        notes += said
    states, commands = topics
    if structure is not None:
        notes += check_floating_base(
            structure, states.names, recording.path, has_pose=recording.base is not None
        )
    if states.position is None:
        raise RecordingError(
            "no state has positions",
            path=recording.path,
            where=states.topic,
            expected="positions of the joints in each state, rad or m",
        )
    states, converted = states_at_joints(states, options.signals, recording.path)
    notes += converted
    clocked = on_one_clock(states, commands, options.clock, recording.path)
    commanded = choose_command_fields(commands, structure, options, recording.path)
    commanded = commands_at_joints(commanded, options.signals, commands.topic, recording.path)
    notes += [*clocked.notes, *commanded.notes]
    between, source = _between(recording, options)
    period = period_of(recording, options) if commands.from_trajectories else None
    if commands.from_trajectories and period is None:
        notes.append(period_note(recording))
    trials: list[Trial] = []
    since = 0.0
    for piece in clocked.pieces:
        maker = _Maker(recording, structure, commanded, options.signals)
        trial = maker.trial(*piece, compares_motion=compares_motion)
        own = (*notes, *maker.notes) if not trials else tuple(maker.notes)
        base = None
        floats = structure is not None and is_floating(structure, trial.joints)
        if recording.base is not None and floats:
            end = max(trial.duration, float(trial.command_time[-1]) if len(trial.time) == 1 else 0)
            base = base_motion(recording.base, trial.start, end, recording.path)
            own = (*own, base.note())
        elif recording.base is not None and structure is not None:
            own = (*own, f"{recording.base.source}: not used, the model's base does not float")
        whole = replace(
            trial, base=base, notes=own, command_between=between, between_source=source,
            offset=since, parts=len(clocked.pieces), unnamed=frozenset(unnamed),
        )  # fmt: skip
        if period is not None:
            whole = held_by_controller(whole, period)
        trials += without_other_modes(whole, maker.other_modes)
        since += trial.duration
    return trials


def _series(recording: Recording, role: str) -> JointSeries:
    found = recording.series.get(role)
    if found is not None and len(found.stamp):
        return found
    if recording.damage:
        raise RecordingError(
            f"no {role} messages in what could be read of a damaged file",
            path=recording.path,
            where=role,
            value=str(recording.damage[0]),
            expected="a whole recording",
        )
    advice = what_to_do(recording, role)
    if "--topics" not in advice:
        advice += "; topics are mapped in twin.yaml or by --topics state=/x,command=/y"
    raise RecordingError(f"no {role} messages", path=recording.path, where=role, expected=advice)


def _between(recording: Recording, options: RecordingOptions) -> tuple[CommandBetween, str]:
    """Course of a command between two stamps, and the source of this information."""
    if options.command_between is not None:
        return options.command_between, "option"
    said = recording.metadata.get("command_between")
    for kind in COMMAND_BETWEEN:
        if said == kind:
            return kind, "metadata"
    if said is not None:
        raise RecordingError(
            "command_between of the trial's metadata is unknown",
            path=recording.path,
            where="metadata 'trial'",
            value=said,
            expected=" or ".join(COMMAND_BETWEEN),
        )
    if options.command_between_default is not None:
        return options.command_between_default, "twin.yaml"
    return "held", "assumed"


class _Maker:
    """Converts states and commands on one clock to one trial."""

    def __init__(
        self,
        recording: Recording,
        structure: Structure | None,
        commanded: ChosenCommands,
        signals: Signals,
    ) -> None:
        self.recording, self.structure, self.commanded = recording, structure, commanded
        self.signals = signals
        self.checks = RecordingChecks(recording.path, structure)
        topics = {series.topic for series in recording.series.values()}
        self.checks.marks += [
            Mark("damage", None, None, 0.0, 0.0, str(item))
            for item in recording.damage
            # Problems of stamps are reported by other marks and notes of the trial.
            if item.place not in topics or not any(said in item.lost for said in _STAMP_TEXTS)
        ]
        self.notes: list[str] = []
        self.other_modes: list[OtherMode] = []

    def trial(
        self, states: TimedMessages, commands: TimedMessages, *, compares_motion: bool
    ) -> Trial:
        """Build one trial, without splitting it."""
        topic = states.series.topic
        rows, joints = self.states(states)
        start = int(rows.stamp[0])
        self.note_order(states, start)
        self.note_order(commands, start)
        time = _seconds(rows.stamp, start)
        self.checks.refuse_coarse_stamps(time, topic)
        position = rows.fields["position"]
        assert position is not None
        command_time, command, own = self.commands(commands, start)
        positions = {
            joint: at
            for at, joint in enumerate(self.commanded.joints)
            if self.commanded.modes[at] == "position"
        }
        motion = RecordedMotion(
            self.recording.path, topic, joints, time, position, command_time, command, positions
        )
        ranges = None if self.structure is None else self.structure.joint_range
        refuse_other_scale(motion, ranges)
        for column, joint in enumerate(joints):
            self.checks.refuse_other_unit(joint, position[:, column], topic)
        for joint, at in positions.items():
            self.checks.refuse_other_unit(joint, command[:, at], commands.series.topic)
        if self.structure is not None:
            self.notes += unwrap_joints(motion, self.structure, self.signals)
        copies, copied = check_copies(motion) if compares_motion else (frozenset(), [])
        self.notes += copied
        if compares_motion:
            self.notes += meaning_changes(motion)
        for joint in copies:
            self.checks.mark("copied", topic, joint, time[0], time[-1], "copies of its commands")
        self.note_twice(topic, time)
        self.note_twice(commands.series.topic, command_time, own)
        self.checks.note_gaps(stamps_of_densest_joint(time, np.isfinite(position)), topic)
        if not commands.series.from_trajectories:
            # A trajectory needs no setpoints while it holds or moves at a constant rate.
            self.checks.note_gaps(stamps_of_densest_joint(command_time, own), commands.series.topic)
        commanded = self.commanded
        for column, joint in enumerate(joints):
            self.mark_positions(joint, position[:, column], time, topic)
            if joint in commanded.joints:
                at = commanded.joints.index(joint)
                seen = np.isfinite(position[:, column])
                self.checks.note_stuck(
                    joint, position[seen, column], time[seen], command[:, at], command_time,
                    commanded.modes[at], topic,
                )  # fmt: skip
        for at, (joint, mode) in enumerate(zip(commanded.joints, commanded.modes, strict=True)):
            if mode == "position":
                self.checks.within_range(joint, command[:, at], command_time, commands.series.topic)
        for joint in commanded.never:
            self.checks.mark(
                "unavailable", commands.series.topic, joint, command_time[0], command_time[-1],
                f"joint {joint!r} is never commanded",
            )  # fmt: skip
        trial = Trial(
            path=self.recording.path,
            start=start,
            joints=joints,
            time=time,
            position=position,
            velocity=self.optional("velocity", rows, joints, time, topic),
            effort=self.optional("effort", rows, joints, time, topic),
            command_joints=commanded.joints,
            command_time=command_time,
            command=command,
            command_modes=commanded.modes,
            metadata=dict(self.recording.metadata),
            marks=tuple(sorted(self.checks.marks, key=lambda mark: mark.start)),
            own_commands=own,
        )
        self.check_unstated_efforts(trial, commands.series.topic)
        self.note_moving_without_command(trial, commands.series.topic)
        self.notes += column_mistakes(trial)
        return trial

    def note_moving_without_command(self, trial: Trial, topic: str) -> None:
        """Note driven joints that move although no command of theirs is used."""
        inputs = {} if self.structure is None else self.structure.joint_inputs
        moves = [
            f"{joint} (by {span:.3g} {self.checks.unit(joint, 'position')})"
            for joint, span in zip(trial.joints, np.ptp(last_known(trial.position), 0), strict=True)
            if span > MOVES
            and joint in inputs
            and joint not in (*trial.command_joints, *self.commanded.left_out)
        ]
        if moves:
            self.notes.append(
                f"{topic}: without a command, although the recording shows motion: "
                f"{list_names(moves)}; position servos of the model hold these joints where they "
                "start, other drives give no effort"
            )

    def states(self, timed: TimedMessages) -> tuple[StateRows, tuple[str, ...]]:
        """States sorted by stamp, from the first at which all joints have been measured."""
        series = timed.series
        order = stamp_order(timed.stamp)
        stamp, picked = timed.stamp[order], timed.rows[order]
        fields = {
            name: None if table is None else table[picked]
            for name in COMMAND_MODES
            for table in [getattr(series, name)]
        }
        samples = own_samples(stamp, fields)
        self.notes += samples.note(series.topic, len(stamp))
        if len(samples.rows) < len(stamp):
            stamp = stamp[samples.rows]
            fields = {n: None if t is None else t[samples.rows] for n, t in fields.items()}
        position = fields["position"]
        assert position is not None
        measured = ~np.isnan(position).all(axis=0)
        joints = tuple(n for n, use in zip(series.names, measured, strict=True) if use)
        if not joints:
            raise self.checks.error(
                "no position is a number", series.topic, value="NaN throughout",
                expected="measured positions",
            )  # fmt: skip
        if not measured.all():
            gone = [n for n, use in zip(series.names, measured, strict=True) if not use]
            self.notes.append(f"{series.topic}: left out, positions are NaN throughout: "
                              f"{list_names(gone)}")  # fmt: skip
            fields = {n: None if t is None else t[:, measured] for n, t in fields.items()}
            position = position[:, measured]
        seconds = _seconds(stamp, int(stamp[0]))
        self.checks.refuse_infinite("position", position, joints, seconds, series.topic)
        carried = np.isfinite(position)
        some = carried.any(axis=1)
        rows = merge_states(
            stamp[some], {n: None if t is None else t[some] for n, t in fields.items()},
            carried[some],
        )  # fmt: skip
        return self.from_first_complete(rows, joints, series.topic, int((~some).sum())), joints

    def from_first_complete(
        self, rows: StateRows, joints: tuple[str, ...], topic: str, without: int
    ) -> StateRows:
        """Rows from the first complete state, which consists of the latest positions."""
        position = rows.fields["position"]
        assert position is not None
        carried = np.isfinite(position)
        known = last_known(position)
        complete = np.isfinite(known).all(axis=1)
        first = int(np.argmax(complete))
        if without:
            self.notes.append(
                f"{topic}: {_messages(without)} without a position of these joints left out"
            )
        if first:
            self.notes.append(
                f"{topic}: {_messages(first)} left out before the first by which every joint was "
                "measured"
            )
        counts = carried.sum(axis=0)
        if rows.merged:
            self.notes.append(f"{topic}: {_messages(rows.merged)} of different joints and one "
                              "stamp taken together")  # fmt: skip
        if counts.min() < _SEPARATE_SHARE * len(carried):
            said = ", ".join(f"{n} in {c}" for n, c in zip(joints, counts.tolist(), strict=True))
            self.notes.append(
                f"{topic}: joints come in separate messages ({said} of {len(carried)}); each is "
                "compared at its own samples"
            )
        elif not carried.all():
            time = _seconds(rows.stamp, int(rows.stamp[first]))
            for column, joint in enumerate(joints):
                self.checks.mark_runs(
                    "unavailable", topic, joint, time,
                    np.flatnonzero(~carried[first:, column]) + first, "position is not filled",
                )  # fmt: skip
        if not first and carried[0].all():
            return rows
        fields = {n: None if t is None else t[first:].copy() for n, t in rows.fields.items()}
        _fill_first_row(rows, fields, first, known[first])
        return StateRows(rows.stamp[first:], fields, rows.merged)

    def commands(
        self, timed: TimedMessages, start: int
    ) -> tuple[FloatArray, FloatArray, NDArray[np.bool_] | None]:
        """(m,) times, s; (m, j) commands; (m, j) whether a message contains them, None for all."""
        topic, joints = timed.series.topic, self.commanded.joints
        order = stamp_order(timed.stamp)
        table = self.commanded.table[timed.rows[order]]
        time = _seconds(timed.stamp[order], start)
        self.checks.refuse_infinite("command", table, joints, time, topic)
        own = ~np.isnan(table)
        rows = timed.rows[order]
        for column, (joint, mode) in enumerate(zip(joints, self.commanded.modes, strict=True)):
            filled = {q: has[rows] for q, has in self.commanded.others.get(joint, {}).items()}
            self.other_modes += other_modes(joint, mode, time, own[:, column], filled)
        if own.all():
            return time, table, None
        some = own.any(axis=1)
        time, table, own = time[some], table[some], own[some]
        commanded = [bool(column.any()) for column in own.T]
        if not all(commanded):
            raise self.checks.error(
                "a joint has no command before or after a step of the clock", topic,
                value=list_names([j for j, has in zip(joints, commanded, strict=True) if not has]),
                expected="one clock, or --clock log",
            )  # fmt: skip
        if not some.all():
            self.notes.append(
                f"{topic}: {_messages(int((~some).sum()))} without a command of these joints left "
                "out"
            )
        counts = own.sum(axis=0)
        if counts.min() < _SEPARATE_SHARE * len(own):
            said = ", ".join(f"{n} in {c}" for n, c in zip(joints, counts.tolist(), strict=True))
            self.notes.append(
                f"{topic}: joints come in separate messages ({said} of {len(own)}); a joint keeps "
                "its command until its next"
            )
        else:
            for column, joint in enumerate(joints):
                self.checks.mark_runs(
                    "unavailable", topic, joint, time, np.flatnonzero(~own[:, column]),
                    "no command, the last one holds",
                )  # fmt: skip
        return time, kept_commands(table), None if own.all() else own

    def mark_positions(
        self, joint: str, position: FloatArray, time: FloatArray, topic: str
    ) -> None:
        """Mark doubtful positions of one joint."""
        seen = np.isfinite(position)
        position, time = position[seen], time[seen]
        self.checks.within_range(joint, position, time, topic)
        self.checks.refuse_contradictions(joint, position, time, topic)
        self.checks.refuse_two_sources(joint, position, topic)
        self.checks.note_outliers(joint, position, time, topic)

    def check_unstated_efforts(self, trial: Trial, topic: str) -> None:
        """Check commands that are efforts only because the model has motors."""
        joints = [
            joint
            for joint in trial.joints
            if joint in self.commanded.unstated and trial.mode_of(joint) == "effort"
        ]
        if not joints:
            return
        later = trial.time >= trial.command_time[0]
        commands = trial.commands_before(trial.time[later])
        self.checks.refuse_positions_as_efforts(
            commands[:, [trial.command_joints.index(joint) for joint in joints]],
            trial.position[later][:, [trial.joints.index(joint) for joint in joints]],
            topic,
        )

    def note_order(self, timed: TimedMessages, start: int) -> None:
        """Mark stamps that are not in the order of the file."""
        back = np.flatnonzero(np.diff(timed.stamp) < 0) + 1
        self.checks.mark_runs(
            "unordered_stamp", timed.series.topic, None, _seconds(timed.stamp, start), back,
            "stamps go back",
        )  # fmt: skip

    def note_twice(
        self, topic: str, time: FloatArray, own: NDArray[np.bool_] | None = None
    ) -> None:
        """Mark stamps of more than one message of a joint, and note many of them.

        Args:
            own: (n, j) whether a message contains each joint; None for all.
        """
        of_joint = [np.arange(len(time))] if own is None else [np.flatnonzero(c) for c in own.T]
        later = [rows[1:][np.diff(time[rows]) == 0] for rows in of_joint]
        twice = np.unique(np.concatenate(later))
        self.checks.mark_runs("duplicate_stamp", topic, None, time, twice, "stamps occur twice")
        if len(twice) > _FEW_TWICE * len(time):
            interval = float(np.median(np.diff(np.unique(time)))) if time[-1] > time[0] else 0.0
            self.notes.append(
                f"{topic}: {len(twice)} of {len(time)} samples have the stamp of the one before: "
                "stamps with too few digits, or of messages that arrived together; times may be "
                f"wrong by an interval ({1e3 * interval:.3g} ms)"
            )

    def optional(
        self, field: str, rows: StateRows, joints: tuple[str, ...], time: FloatArray, topic: str
    ) -> FloatArray | None:
        """An optional field of the states; NaN where it is not filled, None if it never is."""
        table, position = rows.fields[field], rows.fields["position"]
        if table is None or position is None:
            return None
        self.checks.refuse_infinite(field, table, joints, time, topic)
        for column, joint in enumerate(joints):
            missing = np.flatnonzero(np.isnan(table[:, column]) & np.isfinite(position[:, column]))
            self.checks.mark_runs(
                "unavailable", topic, joint, time, missing, f"{field} is not filled"
            )
        return None if np.isnan(table).all() else table


def _fill_first_row(
    rows: StateRows, fields: dict[str, FloatArray | None], first: int, known: FloatArray
) -> None:
    """Fill the first row with the latest position of each joint, extrapolated by its velocity."""
    position, velocity = fields["position"], fields["velocity"]
    before, speed = rows.fields["position"], rows.fields["velocity"]
    assert position is not None
    assert before is not None
    for column in np.flatnonzero(np.isnan(position[0])):
        row = int(np.flatnonzero(np.isfinite(before[: first + 1, column]))[-1])
        late = float(rows.stamp[first] - rows.stamp[row]) * 1e-9
        moved = 0.0 if speed is None else float(np.nan_to_num(speed[row, column]))
        position[0, column] = known[column] + late * moved
        if velocity is not None and speed is not None:
            velocity[0, column] = speed[row, column]


def _seconds(stamp: NDArray[np.int64], start: int) -> FloatArray:
    return np.asarray((stamp - start) * 1e-9, dtype=np.float64)


def _messages(count: int) -> str:
    return "1 message" if count == 1 else f"{count} messages"
