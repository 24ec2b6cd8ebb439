"""A trial: a recording on one clock as one table, with doubtful samples marked."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.recording_options import COMMAND_MODES, CommandBetween, CommandMode
from pytest_twin.trial.base_motion import BaseMotion
from pytest_twin.trial.setpoint import Setpoint, setpoint

MarkKind = Literal[
    "gap", "duplicate_stamp", "unordered_stamp", "outlier", "stuck", "unavailable", "beyond_range",
    "copied", "damage",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Mark:
    """Mark of doubtful samples; the samples are kept.

    Attributes:
        kind: ``gap`` (missing samples), ``duplicate_stamp``, ``unordered_stamp`` (sorted by stamp),
            ``outlier`` (one sample far from the line between its neighbours), ``stuck`` (an encoder
            that does not change while its command moves), ``unavailable`` (an empty field),
            ``beyond_range`` (outside the joint's range), ``copied`` (positions that are copies of
            their commands), ``damage`` (of the file).
        topic: the topic, None for the file.
        joint: the joint, None for all.
        start, end: s from the first state.
    """

    kind: MarkKind
    topic: str | None
    joint: str | None
    start: float
    end: float
    text: str


def stamps_of_densest_joint(time: FloatArray, carried: NDArray[np.bool_] | None) -> FloatArray:
    """(k,) times of the joint with the most samples.

    Where joints come in separate messages, the time between two messages is not the sampling
    interval of a joint.
    """
    if carried is None or carried.all():
        return time
    times: FloatArray = time[carried[:, int(np.argmax(carried.sum(axis=0)))]]
    return times


@dataclass(frozen=True, slots=True)
class Trial:
    """A recording, or a part of it without gaps, ready for replay.

    Attributes:
        start: absolute stamp of the first state, ns.
        joints: (j,) joints of the states, with the names of the model.
        time: (n,) state stamps, s from the first state, not decreasing.
        position: (n, j) measured positions, rad or m; NaN where the message does not contain the
            joint. The first row is complete.
        velocity: (n, j) rad/s or m/s, NaN where it is not filled; or None.
        effort: (n, j) N*m or N, NaN where it is not filled; or None.
        command_joints: (j_c,) commanded joints.
        command_time: (m,) command stamps on the same clock, s, not decreasing; may be negative.
        command: (m, j_c) commands in the units of ``command_modes``; a joint that a message does
            not contain keeps its last command.
        command_modes: (j_c,) command field of each joint.
        metadata: the record ``trial``: role, payload, controller, temperature, IDs.
        marks: marks of doubtful samples, ordered by time.
        command_between: course of a command between two stamps.
        between_source: its source: ``option``, ``metadata``, ``twin.yaml`` or ``assumed``.
        own_commands: (m, j_c) which joints each message contains; None for all.
        notes: rules that were applied while reading, one line each.
        offset: time from the recording's first state to that of this trial, s.
        parts: number of parts into which the recording was split.
        unnamed: roles (``state``, ``command``) whose messages name no joints; these have the order
            of the model's actuators.
        base: motion of the floating base, where its pose was recorded.
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
    command_modes: tuple[CommandMode, ...]
    metadata: Mapping[str, str]
    marks: tuple[Mark, ...] = ()
    command_between: CommandBetween = "held"
    between_source: str = "assumed"
    own_commands: NDArray[np.bool_] | None = None
    notes: tuple[str, ...] = ()
    offset: float = 0.0
    parts: int = 1
    unnamed: frozenset[str] = frozenset()
    base: BaseMotion | None = None

    @property
    def command_mode(self) -> CommandMode | Literal["mixed"]:
        """The command field of all commanded joints, or ``mixed``."""
        modes = set(self.command_modes)
        return modes.pop() if len(modes) == 1 else "mixed"

    @property
    def hardest_mode(self) -> CommandMode:
        """Mode of the joints with the fastest growth of errors: effort, velocity, position."""
        return max(self.command_modes, key=COMMAND_MODES.index)

    @property
    def name(self) -> str:
        """Name of the file; for a part also its start time in the recording."""
        where = f" from {self.offset:.4g} s" if self.parts > 1 else ""
        return f"{self.path.name}{where}"

    @property
    def source(self) -> Literal["robot", "simulation"] | None:
        """What made the recording, by ``source`` in its metadata; None if that says neither."""
        match self.metadata.get("source"):
            case "robot":
                return "robot"
            case "simulation":
                return "simulation"
            case _:
                return None

    @property
    def conditions(self) -> Mapping[str, str]:
        """Conditions of the recording: its metadata without the role."""
        return {key: value for key, value in self.metadata.items() if key != "role"}

    @property
    def stamps(self) -> NDArray[np.int64]:
        """(n,) absolute state stamps, ns."""
        return self.start + np.rint(self.time * 1e9).astype(np.int64)

    @property
    def duration(self) -> float:
        """Time from the first to the last state, s."""
        return float(self.time[-1])

    @property
    def is_dense(self) -> bool:
        """Whether every state has the position of every joint."""
        return bool(np.isfinite(self.position).all())

    def until(self, end: float) -> Trial:
        """The trial with the states up to ``end`` (s) and all commands."""
        rows = slice(int(np.searchsorted(self.time, end, side="right")))
        return replace(
            self,
            time=self.time[rows],
            position=self.position[rows],
            velocity=None if self.velocity is None else self.velocity[rows],
            effort=None if self.effort is None else self.effort[rows],
        )

    def mode_of(self, joint: str) -> CommandMode | None:
        """Command field of a joint; None if it is not commanded."""
        if joint not in self.command_joints:
            return None
        return self.command_modes[self.command_joints.index(joint)]

    @property
    def state_times(self) -> FloatArray:
        """(k,) stamps of the joint with the most samples, s."""
        return stamps_of_densest_joint(self.time, np.isfinite(self.position))

    @property
    def command_times(self) -> FloatArray:
        """(k,) stamps of the joint with the most commands, s."""
        return stamps_of_densest_joint(self.command_time, self.own_commands)

    @property
    def setpoint(self) -> Setpoint:
        """Setpoint as a function of time."""
        return setpoint(self.command_time, self.command, self.command_between, self.own_commands)

    def commands_before(self, time: FloatArray) -> FloatArray:
        """(n, j_c) last command at or before each time (s); before the first command, the first."""
        at = np.searchsorted(self.command_time, time, side="right") - 1
        table: FloatArray = self.command[np.maximum(at, 0)]
        return table

    def marked(self, joint: str, kinds: Iterable[MarkKind]) -> NDArray[np.bool_]:
        """(n,) whether each state of a joint has a mark of these kinds."""
        wanted = set(kinds)
        found = np.zeros(len(self.time), dtype=bool)
        for mark in self.marks:
            if mark.kind in wanted and mark.joint in (None, joint):
                found |= (self.time >= mark.start) & (self.time <= mark.end)
        return found
