"""Mark doubtful samples of a recording, and refuse recordings that contradict the model."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.dependency import Structure
from pytest_twin.errors import RecordingError
from pytest_twin.recording_options import CommandMode
from pytest_twin.trial.gaps import gaps
from pytest_twin.trial.trial import Mark, MarkKind

_UNITS: Mapping[str, tuple[str, str]] = {
    "position": ("rad", "m"),
    "velocity": ("rad/s", "m/s"),
    "effort": ("N*m", "N"),
}
# Robust standard deviations. An outlier is further from the line between its neighbours.
_OUTLIER_DEVIATIONS = 12.0
# An encoder is stuck if it repeats one value for this time, s, while its command changes by this
# amount, rad or m.
_STUCK_SECONDS = 1.0
_STUCK_SPAN = 0.2
# Multiple of the joint's range beyond which positions are in another unit: a degree is 1/57 rad.
_BEYOND_RANGE = 10.0
_SMALL_RANGE = 0.1
"""rad. A smaller range is often an error of unit: MuJoCo read rad as degrees."""
_MOVED = 0.02
"""rad or m. Joints whose positions deviate less (RMS) do not show what follows them."""
_FOLLOWS = 0.2
"""Largest difference (RMS) of commands and positions, relative to the deviation of the positions,
of position commands that are followed. Efforts have another course: gravity, inertia, friction."""
# Larger numbers of marks of one kind are combined into one mark.
_MAX_MARKS = 200
# Two publishers alternate if the distance to the next sample is this many times that to the second
# next one, and at least this distance, rad or m. The third number is the least number of samples.
_ALTERNATION, _ALTERNATION_SPAN, _ALTERNATION_SAMPLES = 10.0, 0.02, 40
# Fraction of states at the time of the one before, above which stamps have too few digits. Two
# publishers of one joint give 0.5.
_SHARED_STAMPS, _FEWEST_STAMPS = 0.55, 10
# Fraction of repeated stamps above which a topic has two publishers.
_REPEATED_SHARE = 0.25


class RecordingChecks:
    """Collects the marks of one recording.

    Args:
        path: path of the recording, for errors.
        structure: structure of the model, for ranges and units; None without a model.
    """

    def __init__(self, path: Path, structure: Structure | None) -> None:
        self.path, self.structure = path, structure
        self.marks: list[Mark] = []

    def error(self, problem: str, where: str, **details: Any) -> RecordingError:
        """Return an error of the recording."""
        return RecordingError(problem, path=self.path, where=where, **details)

    def unit(self, joint: str, field: str) -> str:
        """Unit of a joint's position, velocity or effort."""
        slides = self.structure is not None and self.structure.joint_type.get(joint) == "slide"
        return _UNITS[field][1 if slides else 0]

    def mark(
        self, kind: MarkKind, topic: str, joint: str | None, start: float, end: float, text: str
    ) -> None:
        """Add one mark, s from the first state."""
        self.marks.append(Mark(kind, topic, joint, float(start), float(end), text))

    def mark_runs(
        self,
        kind: MarkKind,
        topic: str,
        joint: str | None,
        time: FloatArray,
        samples: NDArray[np.int64],
        text: str,
    ) -> None:
        """Add one mark for each run of consecutive samples."""
        if not samples.size:
            return
        ends = np.flatnonzero(np.diff(samples) > 1) + 1
        if len(ends) >= _MAX_MARKS:
            said = f"{text} in {len(samples)} messages, at {len(ends) + 1} places"
            self.mark(kind, topic, joint, time[samples].min(), time[samples].max(), said)
            return
        for run in np.split(samples, ends):
            count = "1 message" if len(run) == 1 else f"{len(run)} messages"
            self.mark(kind, topic, joint, time[run].min(), time[run].max(), f"{text} in {count}")

    def refuse_infinite(
        self, field: str, table: FloatArray, joints: tuple[str, ...], time: FloatArray, topic: str
    ) -> None:
        """Check that no value is infinite.

        Raises:
            RecordingError: a value is infinite.
        """
        bad = np.argwhere(np.isinf(table))
        if not bad.size:
            return
        row, column = bad[0]
        joint = joints[column]
        raise self.error(
            f"{field} is not finite in {len(np.unique(bad[:, 0]))} of {len(table)} messages",
            f"{topic} joint '{joint}'",
            value=f"{table[row, column]} at {time[row]:.6g} s",
            expected=f"a finite number of {self.unit(joint, field)}",
        )

    def refuse_coarse_stamps(self, time: FloatArray, topic: str) -> None:
        """Check that states do not share their times, because stamps have too few digits.

        Args:
            time: (n,) stamps of states, s, not decreasing; messages of different joints at one
                stamp are one state.
            topic: name in the recording.

        Raises:
            RecordingError: most states have the time of the one before.
        """
        steps = np.diff(time)
        if len(steps) < _FEWEST_STAMPS or np.mean(steps == 0.0) <= _SHARED_STAMPS:
            return
        different = len(time) - int((steps == 0.0).sum())
        raise self.error(
            "most states have the same time as the one before", topic,
            value=f"{len(time)} states at {different} times",
            expected="stamps that advance from sample to sample, with enough digits; or --clock "
            "log where the recorder's times advance",
        )  # fmt: skip

    def note_gaps(self, time: FloatArray, topic: str) -> None:
        """Mark intervals without messages."""
        found = gaps(time)
        if len(found) > _MAX_MARKS:
            longest = max(float(time[at + 1] - time[at]) for at, _ in found)
            self.mark(
                "gap", topic, None, time[found[0][0]], time[found[-1][0] + 1],
                f"{len(found)} times no message for up to {longest:.4g} s, usually "
                f"{found[0][1]:.4g} s",
            )  # fmt: skip
            return
        for at, usual in found:
            self.mark(
                "gap", topic, None, time[at], time[at + 1],
                f"no message for {time[at + 1] - time[at]:.4g} s, usually {usual:.4g} s",
            )  # fmt: skip

    def limits_of(self, joint: str) -> tuple[float, float] | None:
        """Range of a joint in the model, rad or m; None without a model or a range."""
        return None if self.structure is None else self.structure.joint_range.get(joint)

    def refuse_other_unit(self, joint: str, values: FloatArray, topic: str) -> None:
        """Refuse positions that are so far outside the joint's range that they have another unit.

        Raises:
            RecordingError: they are.
        """
        limits = self.limits_of(joint)
        finite = np.abs(values[np.isfinite(values)])
        if limits is None or not finite.size:
            return
        reach, largest = max(map(abs, limits)), float(finite.max())
        if largest <= _BEYOND_RANGE * reach:
            return
        unit = self.unit(joint, "position")
        guess = way_out = ""
        if unit == "rad":
            degrees = largest * np.pi / 180.0 <= 2.0 * reach
            guess = ", as if in degrees" if degrees else ", as if in encoder counts"
            way_out = "; --units deg reads degrees" if degrees else ""
            if reach < _SMALL_RANGE:
                guess += ", or the model's range is in another unit (compiler angle)"
        elif largest * 1e-3 <= 2.0 * reach:
            guess = ", as if in mm"
        raise self.error(
            f"positions far beyond the joint's range{guess}",
            f"{topic} joint '{joint}'",
            value=f"{largest:.6g}",
            unit=unit,
            expected=f"{_range_in_words(limits, unit)}{way_out}",
        )

    def within_range(self, joint: str, values: FloatArray, time: FloatArray, topic: str) -> None:
        """Mark positions outside the joint's range."""
        limits = self.limits_of(joint)
        if limits is None:
            return
        beyond = np.flatnonzero((values < limits[0]) | (values > limits[1]))
        said = _range_in_words(limits, self.unit(joint, "position"))
        self.mark_runs("beyond_range", topic, joint, time, beyond, f"outside {said}")

    def note_outliers(self, joint: str, position: FloatArray, time: FloatArray, topic: str) -> None:
        """Mark single samples that are far from the line between their neighbours."""
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

    def refuse_two_sources(self, joint: str, position: FloatArray, topic: str) -> None:
        """Check that two publishers do not alternate with different positions of one joint.

        Raises:
            RecordingError: they do.
        """
        if len(position) < _ALTERNATION_SAMPLES:
            return
        to_next = float(np.median(np.abs(np.diff(position))))
        after = float(np.median(np.abs(position[2:] - position[:-2])))
        if to_next > max(_ALTERNATION_SPAN, _ALTERNATION * after):
            apart = f"{to_next:.4g} apart from message to message"
            raise self._two_publishers(joint, topic, "", apart)

    def refuse_contradictions(
        self, joint: str, position: FloatArray, time: FloatArray, topic: str
    ) -> None:
        """Check that two publishers do not send different positions of one joint at one stamp.

        Raises:
            RecordingError: they do.
        """
        same = np.diff(time) == 0.0
        if len(position) < _ALTERNATION_SAMPLES or np.mean(same) < _REPEATED_SHARE:
            return
        apart = float(np.median(np.abs(np.diff(position)[same])))
        if apart > _ALTERNATION_SPAN:
            where = f"{apart:.4g} apart at {int(same.sum())} of {len(position)} stamps"
            raise self._two_publishers(joint, topic, " at the same stamps", where)

    def _two_publishers(self, joint: str, topic: str, when: str, apart: str) -> RecordingError:
        """The error of two publishers of one joint.

        Args:
            joint, topic: names in the recording.
            when: end of the first sentence: when the positions differ.
            apart: distance of the positions in the unit of the joint, and where.
        """
        return self.error(
            f"two publishers send different positions of one joint{when}",
            f"{topic} joint '{joint}'",
            value=apart,
            unit=self.unit(joint, "position"),
            expected="one publisher; record the topic of one robot, or rename the joints of one of "
            "the robots",
        )

    def refuse_positions_as_efforts(
        self, commands: FloatArray, positions: FloatArray, topic: str
    ) -> None:
        """Check that efforts are not positions: no joint that moves follows its command.

        Args:
            commands: (n, joints) commands that the model's motors take as efforts.
            positions: (n, joints) measured positions, rad or m, at the same times.
            topic: name in the recording.

        Raises:
            RecordingError: every joint that moves follows its command.
        """
        known = np.isfinite(commands) & np.isfinite(positions)
        ratios = []
        for column, rows in enumerate(known.T):
            deviation = float(np.std(positions[rows, column])) if rows.any() else 0.0
            if deviation > _MOVED:
                apart = commands[rows, column] - positions[rows, column]
                ratios.append(float(np.sqrt(np.mean(apart**2))) / deviation)
        if ratios and max(ratios) < _FOLLOWS:
            raise self.error(
                "the model's motors take efforts, but the commands are followed as positions",
                topic,
                value=f"positions differ from commands by at most {100 * max(ratios):.2g} % of "
                "their motion (RMS)",
                expected="a model with position servos; or command_mode: effort, if these are "
                "efforts",
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
        """Mark an encoder that does not change while the setpoint moves.

        Effort commands are ignored, because a joint may rest under a changing effort.
        """
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
                self.mark(
                    "stuck", topic, joint, time[begin], time[end],
                    f"stays at {position[begin]:.6g} {self.unit(joint, 'position')} while "
                    "its command moves",
                )  # fmt: skip


def _range_in_words(limits: tuple[float, float], unit: str) -> str:
    return f"the model's range, {limits[0]:.4g} to {limits[1]:.4g} {unit}"
