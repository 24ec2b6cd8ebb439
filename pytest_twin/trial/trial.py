"""What a recording is to everything after the reader: one clock, one table, every doubt marked."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.recording_options import COMMAND_MODES, CommandBetween, CommandMode
from pytest_twin.trial.setpoint import Setpoint, setpoint

MarkKind = Literal[
    "gap", "duplicate_stamp", "unordered_stamp", "outlier", "stuck", "unavailable", "beyond_range",
    "damage",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Mark:
    """A doubt about a stretch of a recording. The samples are kept.

    Attributes:
        kind: ``gap`` (samples missing), ``duplicate_stamp``, ``unordered_stamp`` (sorted by stamp),
            ``outlier`` (one sample off the line of its neighbours), ``stuck`` (an encoder that
            does not move under a moving command), ``unavailable`` (a field that was not
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


def busiest(time: FloatArray, carried: NDArray[np.bool_] | None) -> FloatArray:
    """(k,) times of the joint that most messages carry: where joints come in messages of their own,
    the time between two messages is no interval of any joint."""
    if carried is None or carried.all():
        return time
    times: FloatArray = time[carried[:, int(np.argmax(carried.sum(axis=0)))]]
    return times


@dataclass(frozen=True, slots=True)
class Trial:
    """One recording, or one stretch of it, ready to replay.

    Attributes:
        path: the recording.
        start: absolute stamp of the first state, ns.
        joints: of the states, as the model names them.
        time: (n,) state stamps, s from the first state, not decreasing.
        position: (n, j) rad or m, as measured; NaN where the message of this stamp does not carry
            the joint. The first row is complete.
        velocity: (n, j) rad/s or m/s, or None; NaN where it was not filled.
        effort: (n, j) N*m or N, likewise.
        command_joints: joints that were commanded.
        command_time: (m,) command stamps on the same clock, not decreasing; may be negative.
        command: (m, j_c) in the units of ``command_modes``; a joint that a message does not carry
            keeps its last command.
        command_modes: (j_c,) which field counts for each joint.
        metadata: of the record ``trial``: role, payload, controller, temperature, any IDs.
        marks: doubts, in the order of time.
        command_between: what a command does between two stamps.
        between_source: where that is said: ``option``, ``metadata``, ``twin.yaml`` or ``assumed``.
        own_commands: (m, j_c) which joints each message carries; None where it is all of them.
        notes: rules that were applied while reading, one line each.
        offset: s from the recording's first state to this trial's.
        parts: stretches that the recording was cut into.
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

    @property
    def command_mode(self) -> CommandMode | Literal["mixed"]:
        """The field that counts for every commanded joint, or ``mixed``."""
        modes = set(self.command_modes)
        return modes.pop() if len(modes) == 1 else "mixed"

    @property
    def hardest_mode(self) -> CommandMode:
        """Of the joints' modes the one under which errors grow most: effort, velocity, position."""
        return max(self.command_modes, key=COMMAND_MODES.index)

    @property
    def name(self) -> str:
        """The file's name; of a stretch, with its place in the recording."""
        where = f" from {self.offset:.4g} s" if self.parts > 1 else ""
        return f"{self.path.name}{where}"

    @property
    def conditions(self) -> Mapping[str, str]:
        """What the recording says of itself: its metadata without the role."""
        return {key: value for key, value in self.metadata.items() if key != "role"}

    @property
    def stamps(self) -> NDArray[np.int64]:
        """(n,) absolute state stamps, ns."""
        return self.start + np.rint(self.time * 1e9).astype(np.int64)

    @property
    def duration(self) -> float:
        """From the first state to the last, s."""
        return float(self.time[-1])

    @property
    def is_dense(self) -> bool:
        """Whether every state has the position of every joint."""
        return bool(np.isfinite(self.position).all())

    def until(self, end: float) -> Trial:
        """The same with the states up to ``end``, s; all commands stay."""
        rows = slice(int(np.searchsorted(self.time, end, side="right")))
        return replace(
            self,
            time=self.time[rows],
            position=self.position[rows],
            velocity=None if self.velocity is None else self.velocity[rows],
            effort=None if self.effort is None else self.effort[rows],
        )

    def mode_of(self, joint: str) -> CommandMode | None:
        """The field that counts for a joint; None where it is not commanded."""
        if joint not in self.command_joints:
            return None
        return self.command_modes[self.command_joints.index(joint)]

    @property
    def state_times(self) -> FloatArray:
        """(k,) stamps of the joint that is measured most often, s."""
        return busiest(self.time, np.isfinite(self.position))

    @property
    def command_times(self) -> FloatArray:
        """(k,) stamps of the joint that is commanded most often, s."""
        return busiest(self.command_time, self.own_commands)

    @property
    def setpoint(self) -> Setpoint:
        """What was commanded at every moment."""
        return setpoint(self.command_time, self.command, self.command_between, self.own_commands)

    def commands_before(self, time: FloatArray) -> FloatArray:
        """(n, j_c) the last command at or before each time; before the first, the first."""
        at = np.searchsorted(self.command_time, time, side="right") - 1
        table: FloatArray = self.command[np.maximum(at, 0)]
        return table

    def marked(self, joint: str, kinds: Iterable[MarkKind]) -> NDArray[np.bool_]:
        """(n,) which states of a joint lie under a mark of these kinds."""
        wanted = set(kinds)
        found = np.zeros(len(self.time), dtype=bool)
        for mark in self.marks:
            if mark.kind in wanted and mark.joint in (None, joint):
                found |= (self.time >= mark.start) & (self.time <= mark.end)
        return found
