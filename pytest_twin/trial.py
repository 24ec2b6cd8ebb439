"""A recording made usable: one clock, one order of joints, and every doubt about it marked."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.dependency import Structure
from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import JointSeries, Recording

CommandMode = Literal["position", "velocity", "effort"]
MarkKind = Literal[
    "gap", "duplicate_stamp", "unordered_stamp", "outlier", "stuck", "unavailable", "beyond_range",
    "damage",
]  # fmt: skip

FIELDS: tuple[CommandMode, ...] = ("position", "velocity", "effort")
_UNITS: Mapping[str, tuple[str, str]] = {
    "position": ("rad", "m"),
    "velocity": ("rad/s", "m/s"),
    "effort": ("N*m", "N"),
}

# A sample interval this many times the median is a gap: three samples are missing.
_GAP_INTERVALS = 4.0
# A sample this many robust deviations off the line between its neighbours, and beyond them both.
_OUTLIER_DEVIATIONS = 12.0
# An encoder that repeats one value for this long while its command spans this much, rad or m.
_STUCK_SECONDS = 1.0
_STUCK_SPAN = 0.2
# A command this long before the first state still holds: a latched one.
_LATCHED_SECONDS = 1.0
# Positions this far beyond the joint's range are in another unit: a degree is 1/57 rad.
_BEYOND_RANGE = 10.0


@dataclass(frozen=True, slots=True)
class Mark:
    """A doubt about a stretch of a recording. Nothing is dropped for it.

    Attributes:
        kind: ``gap`` (samples missing), ``duplicate_stamp``, ``unordered_stamp`` (sorted here),
            ``outlier`` (one sample off the line of its neighbours), ``stuck`` (an encoder that
            does not move under a moving command), ``unavailable`` (a field that was never
            filled), ``beyond_range`` (outside the joint's range), ``damage`` (the file itself).
        topic: where; None for the file.
        joint: which, None for all.
        start, end: s from the first state.
        text: in words.
    """

    kind: MarkKind
    topic: str | None
    joint: str | None
    start: float
    end: float
    text: str


@dataclass(frozen=True, slots=True)
class Trial:
    """One recording, ready to replay.

    Attributes:
        path: the recording.
        start: absolute stamp of the first state, ns.
        joints: of the states, in the recording's order.
        time: (n,) state stamps, s from the first state, not decreasing.
        position: (n, j) rad or m, as measured.
        velocity: (n, j) rad/s or m/s, or None; a column that was never filled is NaN.
        effort: (n, j) N*m or N, likewise.
        command_joints: joints that were commanded.
        command_time: (m,) command stamps on the same clock, not decreasing; may be negative.
        command: (m, j_c) in the unit of ``command_mode``.
        command_mode: the field that the commands fill.
        metadata: of the record ``trial``: role, payload, controller, temperature, any IDs.
        marks: doubts, in the order of time.
    """

    path: Path
    start: int
    joints: tuple[str, ...]
    time: FloatArray
    position: FloatArray
    velocity: FloatArray | None
    effort: FloatArray | None
    command_joints: tuple[str, ...]
    command_time: FloatArray
    command: FloatArray
    command_mode: CommandMode
    metadata: Mapping[str, str]
    marks: tuple[Mark, ...] = ()

    @property
    def conditions(self) -> Mapping[str, str]:
        """What it says of itself: its metadata without its role."""
        return {key: value for key, value in self.metadata.items() if key != "role"}

    @property
    def stamps(self) -> NDArray[np.int64]:
        """(n,) absolute state stamps, ns."""
        return self.start + np.rint(self.time * 1e9).astype(np.int64)

    @property
    def duration(self) -> float:
        """From the first state to the last, s."""
        return float(self.time[-1])

    def marked(self, joint: str, kinds: Iterable[MarkKind]) -> NDArray[np.bool_]:
        """(n,) which states of a joint lie under a mark of these kinds."""
        wanted = set(kinds)
        found = np.zeros(len(self.time), dtype=bool)
        for mark in self.marks:
            if mark.kind in wanted and mark.joint in (None, joint):
                found |= (self.time >= mark.start) & (self.time <= mark.end)
        return found


def make_trial(recording: Recording, structure: Structure | None = None) -> Trial:
    """Align a recording's states and commands, and mark what is doubtful about them.

    States and commands are sorted by stamp; of commands with one stamp the last holds.

    Args:
        recording: as read from the file.
        structure: of the model, to hold joints and ranges against; None to go without.

    Raises:
        RecordingError: no states or commands, fewer than two states, no positions, a position or
            command that is not finite, commands in none or more than one field, no overlap in
            time, a joint that the model lacks, or positions in another unit than the model's.
    """
    maker = _Maker(recording, structure)
    return maker.trial()


def _seconds(stamp: NDArray[np.int64], start: int) -> FloatArray:
    return np.asarray((stamp - start) * 1e-9, dtype=np.float64)


class _Maker:
    """Reads one recording into one trial."""

    def __init__(self, recording: Recording, structure: Structure | None) -> None:
        self.recording, self.structure = recording, structure
        self.path = recording.path
        self.marks: list[Mark] = [
            Mark("damage", None, None, 0.0, 0.0, str(item)) for item in recording.damage
        ]

    def trial(self) -> Trial:
        states, commands = self.series("state"), self.series("command")
        if len(states.stamp) < 2:
            raise self.error("too few states", states.topic, value=len(states.stamp), expected="2")
        if states.position is None:
            raise self.error("no state has positions", states.topic)
        start = int(states.stamp.min())
        state_order = self.order(states, start)
        command_order = self.order(commands, start)
        time = _seconds(states.stamp[state_order], start)
        command_time = _seconds(commands.stamp[command_order], start)
        self.overlap(time, command_time, commands.topic)
        position = states.position[state_order]
        self.refuse_holes("position", position, time, states)
        mode, table, commanded = self.commands(commands, command_order, command_time)
        self.note_gaps(time, states.topic)
        self.note_gaps(command_time, commands.topic)
        for column, joint in enumerate(states.names):
            self.hold_against_model(joint, position[:, column], time, states.topic)
            self.note_outliers(joint, position[:, column], time, states.topic)
            if joint in commanded:
                command = table[:, commanded.index(joint)]
                self.note_stuck(
                    joint, position[:, column], time, command, command_time, mode, states.topic
                )
        for joint in commanded:
            self.hold_against_model(
                joint,
                table[:, commanded.index(joint)] if mode == "position" else None,
                command_time,
                commands.topic,
            )
        return Trial(
            path=self.path,
            start=start,
            joints=states.names,
            time=time,
            position=position,
            velocity=self.optional("velocity", states, state_order, time),
            effort=self.optional("effort", states, state_order, time),
            command_joints=commanded,
            command_time=command_time,
            command=table,
            command_mode=mode,
            metadata=dict(self.recording.metadata),
            marks=tuple(sorted(self.marks, key=lambda mark: mark.start)),
        )

    def error(self, problem: str, where: str, **details: Any) -> RecordingError:
        return RecordingError(problem, path=self.path, where=where, **details)

    def unit(self, joint: str, field: str) -> str:
        slides = self.structure is not None and self.structure.joint_type.get(joint) == "slide"
        return _UNITS[field][1 if slides else 0]

    def series(self, role: str) -> JointSeries:
        found = self.recording.series.get(role)
        if found is None or not len(found.stamp):
            if self.recording.damage:
                raise self.error(
                    f"no {role} messages in what could be read of a damaged file",
                    role,
                    value=str(self.recording.damage[0]),
                    expected="a whole recording",
                )
            raise self.error(
                f"no {role} messages",
                role,
                expected=f"a topic for role {role!r}; topics are mapped in twin.yaml or by "
                "--topics state=/x,command=/y",
            )
        return found

    def order(self, series: JointSeries, start: int) -> NDArray[np.int64]:
        """The stable order by stamp, with marks for what it hides."""
        order = np.argsort(series.stamp, kind="stable")
        stamp = series.stamp
        back = np.flatnonzero(np.diff(stamp) < 0) + 1
        self.mark_runs(
            "unordered_stamp", series.topic, None, _seconds(stamp, start), back, "stamps go back"
        )
        time = _seconds(stamp[order], start)
        twice = np.flatnonzero(np.diff(stamp[order]) == 0) + 1
        self.mark_runs("duplicate_stamp", series.topic, None, time, twice, "stamps stand twice")
        return order

    def overlap(self, time: FloatArray, command_time: FloatArray, topic: str) -> None:
        if command_time[0] > time[-1] or command_time[-1] < -_LATCHED_SECONDS:
            raise self.error(
                "commands and states do not overlap in time",
                topic,
                value=f"commands from {command_time[0]:.6g} to {command_time[-1]:.6g} s, "
                f"states from 0 to {time[-1]:.6g}",
                unit="s",
                expected="one clock",
            )

    def refuse_holes(
        self, field: str, table: FloatArray, time: FloatArray, series: JointSeries
    ) -> None:
        holes = np.argwhere(~np.isfinite(table))
        if holes.size:
            row, column = holes[0]
            joint = series.names[column]
            raise self.error(
                f"{field} is not finite in {len(np.unique(holes[:, 0]))} of {len(table)} messages",
                f"{series.topic} joint '{joint}'",
                value=f"{table[row, column]} at {time[row]:.6g} s",
                expected=f"a finite number of {self.unit(joint, field)}",
            )

    def optional(
        self, field: str, series: JointSeries, order: NDArray[np.int64], time: FloatArray
    ) -> FloatArray | None:
        """A field that need not be filled; NaN is where it was not."""
        table: FloatArray | None = getattr(series, field)
        if table is None:
            return None
        table = table[order]
        if np.isinf(table).any():
            self.refuse_holes(field, np.where(np.isnan(table), 0.0, table), time, series)
        for column, joint in enumerate(series.names):
            missing = np.flatnonzero(np.isnan(table[:, column]))
            self.mark_runs(
                "unavailable", series.topic, joint, time, missing, f"{field} is not filled"
            )
        return None if np.isnan(table).all() else table

    def commands(
        self, series: JointSeries, order: NDArray[np.int64], time: FloatArray
    ) -> tuple[CommandMode, FloatArray, tuple[str, ...]]:
        filled = [
            name
            for name in FIELDS
            if (table := getattr(series, name)) is not None and not np.isnan(table).all()
        ]
        if len(filled) != 1:
            raise self.error(
                "commands fill " + (" and ".join(filled) if filled else "no field"),
                series.topic,
                expected="position, velocity or effort, the one that the controller mode uses",
            )
        mode: CommandMode = filled[0]
        table = getattr(series, mode)[order]
        used = ~np.isnan(table).all(axis=0)
        names = tuple(name for name, use in zip(series.names, used, strict=True) if use)
        for name, use in zip(series.names, used, strict=True):
            if not use:
                self.marks.append(
                    Mark(
                        "unavailable",
                        series.topic,
                        name,
                        float(time[0]),
                        float(time[-1]),
                        f"joint {name!r} is never commanded",
                    )
                )
        table = np.ascontiguousarray(table[:, used])
        self.refuse_holes(mode, table, time, replace(series, names=names))
        return mode, table, names

    def hold_against_model(
        self, joint: str, values: FloatArray | None, time: FloatArray, topic: str
    ) -> None:
        """Raise where the model cannot have made such positions; mark what leaves its range."""
        if self.structure is None:
            return
        where = f"{topic} joint '{joint}'"
        if joint not in self.structure.joint_type:
            known = ", ".join(list(self.structure.joint_type)[:12])
            expected = f"one of {known}" if known else "a model with joints"
            raise self.error("the model has no such joint", where, expected=expected)
        limits = self.structure.joint_range.get(joint)
        if values is None or limits is None:
            return
        lower, upper = limits
        reach = max(abs(lower), abs(upper))
        unit = self.unit(joint, "position")
        largest = float(np.abs(values).max())
        said = f"the model's range, {lower:.4g} to {upper:.4g} {unit}"
        if largest > _BEYOND_RANGE * reach:
            guess = ""
            if unit == "rad":
                degrees = largest * np.pi / 180.0 <= 2.0 * reach
                guess = ", as if in degrees" if degrees else ", as if in encoder counts"
            elif largest * 1e-3 <= 2.0 * reach:
                guess = ", as if in mm"
            raise self.error(
                f"positions far beyond the joint's range{guess}",
                where,
                value=f"{largest:.6g}",
                unit=unit,
                expected=said,
            )
        beyond = np.flatnonzero((values < lower) | (values > upper))
        self.mark_runs("beyond_range", topic, joint, time, beyond, f"outside {said}")

    def note_gaps(self, time: FloatArray, topic: str) -> None:
        steps = np.diff(time)
        if len(steps) < 2:
            return
        usual = float(np.median(steps))
        for at in np.flatnonzero(steps > _GAP_INTERVALS * usual) if usual > 0.0 else ():
            self.marks.append(
                Mark(
                    "gap",
                    topic,
                    None,
                    float(time[at]),
                    float(time[at + 1]),
                    f"no message for {steps[at]:.4g} s, usually {usual:.4g} s",
                )
            )

    def note_outliers(self, joint: str, position: FloatArray, time: FloatArray, topic: str) -> None:
        steps = np.diff(position)
        moved = np.abs(steps[steps != 0.0])
        if len(steps) < 8 or not moved.size:
            return
        off = position[1:-1] - 0.5 * (position[:-2] + position[2:])
        spread = 1.4826 * float(np.median(np.abs(off - np.median(off))))
        bound = _OUTLIER_DEVIATIONS * max(spread, float(np.median(moved)))
        alone = (steps[:-1] * steps[1:] < 0) & (
            np.minimum(*np.abs((steps[:-1], steps[1:]))) > bound
        )
        self.mark_runs(
            "outlier", topic, joint, time, np.flatnonzero(alone) + 1, "off the line of neighbours"
        )

    def note_stuck(
        self,
        joint: str,
        position: FloatArray,
        time: FloatArray,
        command: FloatArray,
        command_time: FloatArray,
        mode: CommandMode,
        topic: str,
    ) -> None:
        """An effort leaves a joint at rest for good reasons; a moving setpoint does not."""
        if mode == "effort":
            return
        setpoint = command
        if mode == "velocity":
            travelled = np.cumsum(command[:-1] * np.diff(command_time))
            setpoint = np.concatenate([[0.0], travelled])
        edges = np.flatnonzero(np.diff(position) != 0.0) + 1
        begins = np.concatenate([[0], edges])
        ends = np.concatenate([edges, [len(position)]]) - 1
        still = time[ends] - time[begins] > _STUCK_SECONDS
        for begin, end in zip(begins[still], ends[still], strict=True):
            during = setpoint[(command_time >= time[begin]) & (command_time <= time[end])]
            if during.size and float(np.ptp(during)) > _STUCK_SPAN:
                self.marks.append(
                    Mark(
                        "stuck",
                        topic,
                        joint,
                        float(time[begin]),
                        float(time[end]),
                        f"stays at {position[begin]:.6g} {self.unit(joint, 'position')} while "
                        "its command moves",
                    )
                )

    def mark_runs(
        self,
        kind: MarkKind,
        topic: str,
        joint: str | None,
        time: FloatArray,
        samples: NDArray[np.int64],
        text: str,
    ) -> None:
        """One mark for each run of neighbouring samples."""
        if not samples.size:
            return
        for run in np.split(samples, np.flatnonzero(np.diff(samples) > 1) + 1):
            count = "1 message" if len(run) == 1 else f"{len(run)} messages"
            self.marks.append(
                Mark(
                    kind,
                    topic,
                    joint,
                    float(time[run].min()),
                    float(time[run].max()),
                    f"{text} in {count}",
                )
            )
