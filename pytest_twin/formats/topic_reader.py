"""Collect the messages of one topic into one table of joints."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import LimitError, RecordingError, require_at_most
from pytest_twin.formats import limits
from pytest_twin.formats.bag import Channel, Region
from pytest_twin.formats.batches import named_joints, note_not_finite, table_of
from pytest_twin.formats.decompression import ZSTD_MAGIC, decompress_messages
from pytest_twin.formats.message_types import (
    ANY_QUANTITY,
    TRAJECTORIES,
    MessageType,
    encodings_of,
    known_types,
    long_name,
    message_type,
)
from pytest_twin.formats.recording import JointSeries, Notes
from pytest_twin.formats.ros_serialization import (
    QUANTITIES,
    Batch,
    Encoding,
    Floats,
    Integers,
    MessageError,
)
from pytest_twin.formats.trajectory import STOP, is_stop
from pytest_twin.formats.trajectory_course import TooManySetpointsError
from pytest_twin.formats.trajectory_setpoints import Setpoints, TrajectoryMessage, play

_LATE = 0.1
"""s. A trajectory that arrives later than this after its stamp has missed a visible part."""
_OTHER_CLOCK = 1.0
"""s. Stamps that differ more from the log times are on another clock."""
_MOVED = 0.02
"""rad or m. A joint that moves less before its first trajectory rests."""


@dataclass
class TopicReader:
    """Collects one topic's messages for one role.

    Attributes:
        role: ``state`` or ``command``: some types contain both.
        path: the file that errors name.
        notes: receives lost or doubtful messages.
        remarks: receives assumptions about what the message type does not state.
    """

    topic: str
    role: str
    path: Path
    notes: Notes
    remarks: Notes
    schema: str = ""
    first_named: dict[str, tuple[int, int]] = field(default_factory=dict)
    order: list[Integers] = field(default_factory=list)
    log_times: list[Integers] = field(default_factory=list)
    batches: list[Batch] = field(default_factory=list)
    seen: int = 0
    samples: int = 0
    bad: int = 0
    first_bad: str = ""
    bad_stamps: int = 0
    unpacked_bytes: int = 0
    types: dict[tuple[Channel, str | None], MessageType] = field(default_factory=dict)

    def read(self, region: Region, rows: Integers, channel: Channel, schema: str | None) -> None:
        """Decode messages of one channel.

        Args:
            region: block that contains the messages.
            rows: indices of the messages in the region.

        Raises:
            RecordingError: the type or encoding is not supported.
            LimitError: beyond ``limits.MCAP``.
        """
        kind = self._type_of(channel, schema)
        if channel.encoding == "json":
            for row, start in enumerate(region.start[rows].tolist()):
                message = region.data[start : start + int(region.size[rows[row]])]
                try:
                    self._keep(kind.from_json(message, row), region, rows)
                except MessageError as error:
                    self._keep((row, error), region, rows)
        else:
            if self.is_compressed(region, rows):
                region, rows = self._unpack(region, rows), np.arange(len(rows))
            encoding: Encoding = "ros1" if channel.encoding == "ros1" else "cdr"
            for found in kind.serialized(
                region.data, region.start[rows], region.size[rows], encoding
            ):
                self._keep(found, region, rows)
        self.seen += len(rows)

    @staticmethod
    def is_compressed(region: Region, rows: Integers) -> bool:
        """Whether rosbag2 has compressed each message; CDR never begins with these bytes."""
        start, size = int(region.start[rows[0]]), int(region.size[rows[0]])
        return size >= 4 and region.data[start : start + 4] == ZSTD_MAGIC

    def _unpack(self, region: Region, rows: Integers) -> Region:
        left = limits.MCAP.uncompressed_bytes - self.unpacked_bytes
        found = decompress_messages(region, rows, left, self.path, self.topic)
        self.unpacked_bytes += len(found.data)
        return found

    def _keep(
        self, found: Batch | tuple[int, MessageError], region: Region, rows: Integers
    ) -> None:
        if isinstance(found, tuple):
            row, problem = found
            self.bad += 1
            self.first_bad = self.first_bad or (
                f"message {self.seen + row} ({region.place}, byte {int(region.start[rows[row]])} "
                f"of its content): {problem}"
            )
            require_at_most(
                self.bad,
                limits.MCAP.undecodable_count,
                f"too many messages that cannot be decoded, first {self.first_bad}",
                path=self.path,
                where=self.topic,
            )
            return
        self._take_names(found.names, self.seen + int(found.rows[0]))
        self.samples += len(found.rows) * len(found.names)
        require_at_most(
            self.samples,
            limits.MCAP.samples_count,
            "too many samples",
            path=self.path,
            where=self.topic,
        )
        self.order.append(found.rows + self.seen)
        self.log_times.append(region.log_time[rows[found.rows]])
        self.batches.append(found)
        self.bad_stamps += found.bad_stamp

    def _take_names(self, names: tuple[str, ...], message: int) -> None:
        """Add joints to the topic's joints, with the first message that names each."""
        for place, name in enumerate(names):
            first = (message, place)
            if first < self.first_named.get(name, (message + 1, 0)):
                self.first_named[name] = first

    def _type_of(self, channel: Channel, schema: str | None) -> MessageType:
        known = self.types.get((channel, schema))
        if known is not None:
            return known
        encodings = encodings_of(schema or "")
        if channel.encoding not in encodings:
            raise RecordingError(
                "unknown message encoding",
                path=self.path,
                where=self.topic,
                value=channel.encoding,
                expected=f"{', '.join(encodings)} for {schema or 'this topic'}",
            )
        # JSON needs no schema, and a JSON schema may have any name.
        kind = message_type(schema or "", self.role)
        if kind is None and channel.encoding == "json":
            schema = "sensor_msgs/msg/JointState"
            kind = message_type(schema, self.role)
        if kind is None:
            raise RecordingError(
                "unknown schema",
                path=self.path,
                where=self.topic,
                value=schema or "none",
                expected=f"for role {self.role!r} one of {known_types(self.role)}",
            )
        self.schema = self.schema or long_name(schema or "")
        self.types[channel, schema] = kind
        return kind

    def finish(self, states: JointSeries | None = None) -> JointSeries | None:
        """Return the topic's table; None if it has no messages.

        Args:
            states: the recorded states, whose first positions and clock trajectories need.

        Raises:
            RecordingError: none of its messages can be decoded.
            LimitError: beyond ``limits.MCAP``.
        """
        if self.bad:
            if not self.batches:
                raise RecordingError(
                    f"no message can be decoded, first {self.first_bad}",
                    path=self.path,
                    where=self.topic,
                    expected=self.schema,
                )
            self.notes.add(
                self.topic,
                f"{self.bad} of {self.seen} messages are lost, they cannot be decoded; first "
                f"{self.first_bad}",
            )
        if not self.batches:
            return None
        # The messages of one region may be in any order.
        names = tuple(sorted(self.first_named, key=self.first_named.__getitem__))
        self._refuse_wide(len(names))
        order = np.argsort(np.concatenate(self.order), kind="stable")
        log_time = np.concatenate(self.log_times)[order]
        if self.schema in TRAJECTORIES:
            return self._played(names, states)
        stamp = np.concatenate([batch.stamp for batch in self.batches])[order]
        tables = {name: table_of(self.batches, name, names, order) for name in QUANTITIES}
        carried = named_joints(self.batches, names, order)
        for name in QUANTITIES:
            note_not_finite(self.notes, self.topic, name, tables, names, carried)
        if self.schema in ANY_QUANTITY:
            tables = self._of_one_quantity(tables)
            self._note_places(names)
        return JointSeries(
            topic=self.topic,
            names=names,
            stamped=len(stamp) < 2 or bool(stamp.any()),
            stamp=self._usable_stamps(stamp, log_time),
            log_time=log_time,
            position=tables["position"],
            velocity=tables["velocity"],
            effort=tables["effort"],
        )

    def _played(self, names: tuple[str, ...], states: JointSeries | None) -> JointSeries:
        """Convert trajectories to setpoints as their controller plays them.

        Raises:
            RecordingError: no trajectory has points.
            LimitError: beyond ``limits.MCAP``.
        """
        if all(is_stop(batch) for batch in self.batches):
            raise RecordingError(
                STOP, path=self.path, where=self.topic, expected="a trajectory with points"
            )
        in_file = np.argsort([int(rows[0]) for rows in self.order], kind="stable").tolist()
        batches = [self.batches[at] for at in in_file]
        stamp = np.array([int(batch.stamp[0]) for batch in batches], dtype=np.int64)
        received = np.array([int(self.log_times[at][0]) for at in in_file], dtype=np.int64)
        offset = _log_after_stamp(states)
        unset = stamp == 0
        start = np.where(unset, received, stamp)
        if offset is not None and abs(offset) > _OTHER_CLOCK * 1e9 and not unset.all():
            start = np.where(unset, received - offset, stamp)
        self._remark_starts(start, received, unset, offset)
        messages = [
            TrajectoryMessage(
                batch.names,
                begin,
                np.zeros(0, np.int64) if is_stop(batch) or batch.after is None else batch.after,
                batch.values,
                batch.acceleration,
            )
            for batch, begin in zip(batches, start.tolist(), strict=True)
        ]
        try:
            played = play(messages, names, _first_positions(states), limits.MCAP.samples_count)
        except TooManySetpointsError:
            raise LimitError(
                "too many samples of the curves of trajectories",
                path=self.path,
                where=self.topic,
                expected=f"at most {limits.MCAP.samples_count}",
            ) from None
        self._remark_courses(messages, played, states)
        # A message may be sent long before its start, so that its own log time shows no offset.
        late = received - start if offset is None else np.where(unset, received - start, offset)
        log_time = played.time + late[played.message]
        return JointSeries(
            topic=self.topic,
            names=names,
            stamped=True,
            from_trajectories=True,
            stamp=self._usable_stamps(played.time, log_time),
            log_time=log_time,
            position=played.values["position"],
            velocity=played.values["velocity"],
            effort=played.values["effort"],
        )

    def _remark_starts(
        self,
        start: Integers,
        received: Integers,
        unset: NDArray[np.bool_],
        offset: int | None,
    ) -> None:
        if unset.any():
            self.remarks.add(
                self.topic,
                f"{int(unset.sum())} trajectories without header.stamp begin when the recorder "
                "received them",
            )
        if offset is None or unset.all():
            return
        late = (received - start - offset)[~unset] * 1e-9
        if (late > _LATE).any():
            self.remarks.add(
                self.topic,
                f"{int((late > _LATE).sum())} trajectories arrived after their header.stamp, by up "
                f"to {late.max():.4g} s: they are taken to begin at the stamp",
            )

    def _remark_courses(
        self, messages: list[TrajectoryMessage], played: Setpoints, states: JointSeries | None
    ) -> None:
        stops = sum(not len(message.after) for message in messages)
        if stops:
            self.remarks.add(
                self.topic,
                f"{stops} trajectories without points are taken as a stop: the joints hold their "
                "setpoint",
            )
        if played.overtaken:
            self.remarks.add(
                self.topic,
                f"{played.overtaken} trajectories leave out joints that are still moving: these "
                "are taken to finish their trajectory (allow_trajectory_replacement)",
            )
        if played.from_unknown:
            self.remarks.add(
                self.topic,
                f"{played.from_unknown} trajectories begin at a setpoint that is not recorded: the "
                "first point is taken to hold until its time",
            )
        if not played.from_first_state:
            return
        begin = next(message.start for message in messages if len(message.after))
        said = "the first trajectory begins at the position of the first state"
        moved = _moved_before(states, begin)
        if moved:
            joint, distance = moved
            said += (
                f", but {joint} moved by {distance:.4g} rad or m before it: its setpoint there is "
                "not recorded"
            )
        self.remarks.add(self.topic, said)

    def _of_one_quantity(self, tables: dict[str, Floats | None]) -> dict[str, Floats | None]:
        """Determine the quantity of the values from the topic's name."""
        named = [name for name in QUANTITIES if name in self.topic.lower()]
        if len(named) == 1:
            self.remarks.add(
                self.topic,
                f"{self.schema} does not say whether it holds positions, velocities or efforts; "
                f"the topic's name says {named[0]}",
            )
            return {name: tables[name] if name in named else None for name in QUANTITIES}
        return tables

    def _note_places(self, names: tuple[str, ...]) -> None:
        if all(name == str(place) for place, name in enumerate(names)):
            self.remarks.add(
                self.topic,
                f"its {len(names)} values have no joint names (labels of layout.dim): joints are "
                f"numbered 0 to {len(names) - 1}",
            )

    def _refuse_wide(self, joints: int) -> None:
        """Refuse tables that messages with different joints make far larger than the file."""
        rows = sum(len(batch.rows) for batch in self.batches)
        require_at_most(
            rows * joints,
            limits.MCAP.samples_count,
            f"too many samples: {rows} messages that name {joints} joints between them",
            path=self.path,
            where=self.topic,
        )

    def _usable_stamps(self, stamp: Integers, log_time: Integers) -> Integers:
        unset = int((stamp == 0).sum())
        if (log_time < 0).any():
            self.notes.add(self.topic, "log times beyond the year 2262 read as negative")
        if self.schema in ANY_QUANTITY:
            self.remarks.add(
                self.topic, f"{self.schema} has no stamp: the recorder's log time is used"
            )
            stamp = log_time
        elif unset == len(stamp) and len(stamp) > 1:
            self.notes.add(
                self.topic, "no message has a header.stamp: the recorder's log time is used"
            )
            stamp = log_time
        elif unset > 1 or (unset and stamp[0] != 0):
            at = int(np.flatnonzero(stamp == 0)[0])
            self.notes.add(self.topic, f"{unset} messages without header.stamp, first message {at}")
        if self.bad_stamps:
            self.notes.add(self.topic, f"{self.bad_stamps} stamps have nanosec of a second or more")
        step = np.diff(stamp)
        for what, bad in (("go back", step < 0), ("occur twice", step == 0)):
            if bad.any():
                at = int(np.flatnonzero(bad)[0]) + 1
                self.notes.add(self.topic, f"{int(bad.sum())} stamps {what}, first message {at}")
        return stamp


def _log_after_stamp(states: JointSeries | None) -> int | None:
    """Median time from stamp to log time of the states, ns; None where they have no stamps."""
    if states is None or not states.stamped or (states.stamp == 0).all():
        return None
    return int(np.median(states.log_time - states.stamp))


def _first_positions(states: JointSeries | None) -> dict[str, float]:
    """Joint -> its first recorded position; later ones would be the result of the commands."""
    if states is None or states.position is None:
        return {}
    return {
        name: float(measured[0])
        for name, column in zip(states.names, states.position.T, strict=True)
        if (measured := column[np.isfinite(column)]).size
    }


def _moved_before(states: JointSeries | None, begin: int) -> tuple[str, float] | None:
    """Joint that moved most before a time (ns), and by how much; None where all rested."""
    if states is None or states.position is None or not len(states.stamp):
        return None
    # A trajectory without a stamp begins at a time of the recorder, whose clock may be another one
    # than that of the states, as in a simulation.
    is_on_their_clock = int(states.stamp.min()) <= begin <= int(states.stamp.max())
    before = states.position[(states.stamp if is_on_their_clock else states.log_time) <= begin]
    spans = {
        name: float(np.ptp(measured))
        for name, column in zip(states.names, before.T, strict=True)
        if (measured := column[np.isfinite(column)]).size
    }
    joint = max(spans, key=lambda name: spans[name], default=None)
    return None if joint is None or spans[joint] < _MOVED else (joint, spans[joint])
