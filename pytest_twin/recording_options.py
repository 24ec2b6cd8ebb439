"""How a recording is to be read: what ``twin.yaml`` or a command line says about it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, Self, get_args

CommandMode = Literal["position", "velocity", "effort"]
"""Which field of a command message counts."""
Clock = Literal["stamp", "log"]
"""``stamp``: ``header.stamp`` of the messages. ``log``: when the recorder received them."""
CommandBetween = Literal["held", "interpolated", "ramped"]
"""What a command does between two stamps.

``held``: a step at each stamp. ``interpolated``: linear from stamp to stamp. ``ramped``: linear
from the stamp to one command period after it, then held.
"""

Units = Literal["rad", "deg"]

COMMAND_MODES: tuple[CommandMode, ...] = get_args(CommandMode)
CLOCKS: tuple[Clock, ...] = get_args(Clock)
COMMAND_BETWEEN: tuple[CommandBetween, ...] = get_args(CommandBetween)
UNITS: tuple[Units, ...] = get_args(Units)


@dataclass(frozen=True, slots=True)
class JointNames:
    """From the joint names of a recording to those of the model.

    Attributes:
        prefix, suffix: what one side has around the names of the other: ``left_`` for
            ``left_elbow`` in the recording and ``elbow`` in the model, or the other way round.
        names: recorded name -> name in the model; goes before prefix and suffix.
    """

    prefix: str = ""
    suffix: str = ""
    names: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, table: Mapping[str, str]) -> Self:
        """From one table, where ``prefix`` and ``suffix`` are reserved keys."""
        names = {k: v for k, v in table.items() if k not in ("prefix", "suffix")}
        return cls(table.get("prefix", ""), table.get("suffix", ""), names)

    @property
    def table(self) -> dict[str, str]:
        """The inverse of :meth:`of`."""
        around = {"prefix": self.prefix, "suffix": self.suffix}
        return {k: v for k, v in around.items() if v} | dict(self.names)

    def in_model(self, recorded: str, joints: Collection[str]) -> str:
        """The model's name of a recorded joint; the recorded name where no rule applies."""
        if recorded in self.names:
            return self.names[recorded]
        if not (self.prefix or self.suffix):
            return recorded
        if recorded.startswith(self.prefix) and recorded.endswith(self.suffix):
            bare = recorded.removeprefix(self.prefix).removesuffix(self.suffix)
            if bare in joints or not joints:
                return bare
        longer = f"{self.prefix}{recorded}{self.suffix}"
        return longer if longer in joints else recorded


@dataclass(frozen=True, slots=True)
class RecordingOptions:
    """What a user declares about recordings; None and empty where the tool decides by itself.

    Attributes:
        joints: from recorded joint names to the model's.
        command_mode: the field that counts, for all joints or joint (as the model names it) ->
            field.
        clock: which times count.
        command_between: what a command does between two stamps, whatever the recording says.
        command_between_default: likewise, where the recording's own metadata does not say it.
        columns: of CSV files: header -> what the column is, or the other way round.
        units: of LeRobot data sets: the unit of their joints.
    """

    joints: JointNames = field(default_factory=JointNames)
    command_mode: CommandMode | Mapping[str, CommandMode] | None = None
    clock: Clock | None = None
    command_between: CommandBetween | None = None
    command_between_default: CommandBetween | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Units | None = None

    def mode_of(self, joint: str) -> CommandMode | None:
        """The declared field for a joint of the model."""
        if isinstance(self.command_mode, Mapping):
            return self.command_mode.get(joint)
        return self.command_mode

    def over(self, other: RecordingOptions) -> RecordingOptions:
        """These options, and those of ``other`` where these say nothing."""
        empty = RecordingOptions()
        chosen = {
            f.name: mine if (mine := getattr(self, f.name)) != getattr(empty, f.name)
            else getattr(other, f.name)
            for f in fields(self)
        }  # fmt: skip
        return RecordingOptions(**chosen)

    def to_json(self) -> dict[str, Any]:
        """JSON-able; what says nothing is left out."""
        mode = self.command_mode
        found = {
            "joints": self.joints.table,
            "command_mode": dict(mode) if isinstance(mode, Mapping) else mode,
            "clock": self.clock,
            "command_between": self.command_between,
            "command_between_default": self.command_between_default,
            "columns": dict(self.columns),
            "units": self.units,
        }
        return {key: value for key, value in found.items() if value}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """The inverse of :meth:`to_json`; other keys are ignored."""
        return cls(
            joints=JointNames.of(data.get("joints") or {}),
            command_mode=data.get("command_mode"),
            clock=data.get("clock"),
            command_between=data.get("command_between"),
            command_between_default=data.get("command_between_default"),
            columns=dict(data.get("columns") or {}),
            units=data.get("units"),
        )


NO_OPTIONS = RecordingOptions()
