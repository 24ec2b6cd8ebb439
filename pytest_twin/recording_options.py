"""How to read a recording, as declared in ``twin.yaml`` or on the command line."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, Self, get_args

from pytest_twin.formats import typed
from pytest_twin.signals import NO_SIGNALS, Signals

CommandMode = Literal["position", "velocity", "effort"]
"""Which field of a command message is the command."""
Clock = Literal["stamp", "log"]
"""``stamp``: ``header.stamp`` of the messages. ``log``: when the recorder received them."""
CommandBetween = Literal["held", "interpolated", "ramped"]
"""Course of a command between two stamps.

``held``: constant, with a step at each stamp (zero-order hold). ``interpolated``: linear from
stamp to stamp. ``ramped``: linear from the stamp to one command period after it, then constant.
"""

Base = Literal["fixed"]
"""``fixed``: a rig held the floating base of the robot in the pose that the model gives it."""
Units = Literal["rad", "deg", "percent"]
TimeUnit = Literal["s", "ms", "us", "ns"]

COMMAND_MODES: tuple[CommandMode, ...] = get_args(CommandMode)
CLOCKS: tuple[Clock, ...] = get_args(Clock)
COMMAND_BETWEEN: tuple[CommandBetween, ...] = get_args(CommandBetween)
LONGEST_PERIOD = 1.0
"""Longest period of a controller, s."""
BASES: tuple[Base, ...] = get_args(Base)
UNITS: tuple[Units, ...] = get_args(Units)
TIME_UNITS: tuple[TimeUnit, ...] = get_args(TimeUnit)


@dataclass(frozen=True, slots=True)
class JointNames:
    """Mapping from the joint names of a recording to those of the model.

    Attributes:
        prefix, suffix: text that either the recording or the model adds to each name: ``left_``
            for ``left_elbow`` in the recording and ``elbow`` in the model, or the reverse.
        names: recorded name -> name in the model; takes precedence over prefix and suffix.
    """

    prefix: str = ""
    suffix: str = ""
    names: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, table: Mapping[str, str]) -> Self:
        """Build the mapping from one table, where ``prefix`` and ``suffix`` are reserved keys."""
        names = {k: v for k, v in table.items() if k not in ("prefix", "suffix")}
        return cls(table.get("prefix", ""), table.get("suffix", ""), names)

    @property
    def table(self) -> dict[str, str]:
        """The table from which :meth:`of` builds this mapping."""
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
    """Declared properties of recordings; None or empty where they are detected from the data.

    Attributes:
        joints: mapping from recorded joint names to the model's.
        command_mode: field that is the command: one for all joints, or joint (as the model names
            it) -> field.
        clock: which time stamps to use.
        command_between: course of a command between two stamps; overrides the recording.
        command_between_default: the same for recordings whose metadata do not state it.
        controller_period: s for which a controller holds each setpoint of a trajectory; overrides
            the recording's metadata.
        columns: CSV files: header -> meaning of the column, or the reverse.
        units: unit of the angles, where the recording states none or a wrong one.
        time_unit: CSV files: unit of the times.
        motor_calibration: LeRobot data sets: path of the JSON file of the arm's motors.
        signals: side of the gears, units and meaning of the joints' positions and efforts.
        base: what held the robot's floating base.
    """

    joints: JointNames = field(default_factory=JointNames)
    command_mode: CommandMode | Mapping[str, CommandMode] | None = None
    clock: Clock | None = None
    command_between: CommandBetween | None = None
    command_between_default: CommandBetween | None = None
    controller_period: float | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Units | None = None
    time_unit: TimeUnit | None = None
    motor_calibration: str | None = None
    signals: Signals = NO_SIGNALS
    base: Base | None = None

    def mode_of(self, joint: str) -> CommandMode | None:
        """The declared command field of a joint of the model; None where it is not declared."""
        if isinstance(self.command_mode, Mapping):
            return self.command_mode.get(joint)
        return self.command_mode

    def over(self, other: RecordingOptions) -> RecordingOptions:
        """Return these options, completed with those of ``other`` where these are not declared."""
        empty = RecordingOptions()
        chosen = {
            f.name: mine if (mine := getattr(self, f.name)) != getattr(empty, f.name)
            else getattr(other, f.name)
            for f in fields(self)
        }  # fmt: skip
        return RecordingOptions(**chosen)

    def to_json(self) -> dict[str, Any]:
        """Return the declared options as JSON-able values."""
        own_tables = {"joints": self.joints.table, "signals": dict(self.signals.table)}
        return {k: v for k, v in {**typed.plain(self), **own_tables}.items() if v}

    @property
    def reading(self) -> dict[str, Any]:
        """The options that readers take, as keyword arguments of ``read_recordings``."""
        motors = self.motor_calibration
        return {
            "columns": self.columns,
            "units": self.units,
            "time_unit": self.time_unit,
            "motor_calibration": None if motors is None else Path(motors),
            "has_signals": bool(self.signals.table),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Build options from what :meth:`to_json` returned; other keys are ignored."""
        scalars = {k: v for k, v in data.items() if v and k not in ("joints", "signals")}
        return replace(
            typed.build(scalars, cls),
            joints=JointNames.of(data.get("joints") or {}),
            signals=Signals.from_json(data.get("signals") or {}),
        )


NO_OPTIONS = RecordingOptions()
