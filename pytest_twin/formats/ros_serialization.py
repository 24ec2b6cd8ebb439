"""Decode serialized ROS messages with equal layouts, many at a time.

ROS 2 writes CDR: OMG "Data Distribution Service Interoperability Wire Protocol" 2.5, section 10
(XCDR1). A message has four bytes of encapsulation, then fields aligned to their size. ROS 1 writes
the same fields little-endian without alignment, and its strings without a final NUL.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pytest_twin.formats import limits

QUANTITIES = ("position", "velocity", "effort")

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Encoding = Literal["cdr", "ros1"]

# After this many layouts of one message size, the remaining messages are decoded one by one.
_LAYOUTS_PER_GROUP = 16


class MessageError(ValueError):
    """A message cannot be decoded as its type; the text has the reason."""


@dataclass(frozen=True)
class Batch:
    """Messages that carry the same joints.

    Attributes:
        rows: (n,) index of each message among the decoded ones; a message with several
            setpoints occurs once for each.
        names: joints, in the order of the messages.
        stamp: (n,) ``header.stamp``, ns; 0 if a message has none.
        bad_stamp: number of stamps with ``nanosec`` of a second or more.
        values: quantity -> (n, j) in SI units, or None if it is empty in these messages.
        after: (n,) time of each setpoint after its message's time, ns; None if all are 0.
        acceleration: (n, j) of trajectories, rad/s^2 or m/s^2; None if it is empty.
    """

    rows: Integers
    names: tuple[str, ...]
    stamp: Integers
    bad_stamp: int
    values: Mapping[str, Floats | None]
    after: Integers | None = None
    acceleration: Floats | None = None


@dataclass(frozen=True)
class Layout:
    """Byte positions of the fields of a message, and the bytes that determine them.

    Attributes:
        order: byte order, ``<`` (little-endian) or ``>`` (big-endian).
        stamp_at: byte of ``header.stamp``, None where the type has no header.
        values_at: quantity -> byte of each joint's value, -1 for a joint without a value; empty
            quantities are omitted.
        structure: byte ranges that are equal in all messages of this layout.
    """

    names: tuple[str, ...]
    order: str
    stamp_at: int | None
    values_at: Mapping[str, tuple[int, ...]]
    structure: tuple[tuple[int, int], ...]


LayoutOf = Callable[["Cursor"], Layout]
Decoded = Batch | tuple[int, MessageError]


class Cursor:
    """Reads the fields of one message in order, and records which bytes were lengths or text."""

    def __init__(self, message: bytes, encoding: Encoding = "cdr") -> None:
        self.message = message
        self.cdr = encoding == "cdr"
        self.structure: list[tuple[int, int]] = []
        self.order, self.at = "<", 0
        if self.cdr:
            if len(message) < 4:
                raise MessageError("shorter than its encapsulation")
            if message[:2] not in (b"\x00\x00", b"\x00\x01"):
                raise MessageError(f"encapsulation 0x{message[:2].hex()} is not plain CDR")
            self.order, self.at = "<" if message[1] == 1 else ">", 4
            self.structure.append((0, 2))
        self._count = struct.Struct(self.order + "I")

    def align(self, size: int) -> None:
        """Move to the next position that is aligned to ``size`` bytes."""
        if self.cdr:
            self.at += (4 - self.at) % size

    def skip(self, size: int, what: str, align: int = 4) -> int:
        """Skip a field whose value may differ between messages; return its position."""
        self.align(align)
        first = self.at
        if first + size > len(self.message):
            raise MessageError(f"ends inside {what}")
        self.at += size
        return first

    def count(self, what: str) -> int:
        """Read a length."""
        start = self.at
        first = self.skip(4, what)
        self._keep(start, self.at)
        return int(self._count.unpack_from(self.message, first)[0])

    def text(self, what: str) -> str:
        """Read a string."""
        size = self.count(what)
        first = self.at
        if first + size > len(self.message):
            raise MessageError(f"{what} is longer than the message")
        self.at += size
        self._keep(first, self.at)
        try:
            return self.message[first : self.at].removesuffix(b"\0").decode("utf-8")
        except UnicodeDecodeError:
            raise MessageError(f"{what} is not UTF-8") from None

    def integers(self, form: str, what: str) -> tuple[int, ...]:
        """Read integers of four bytes, one for each ``i`` or ``I`` in ``form``."""
        first = self.skip(4 * len(form), what)
        return struct.unpack_from(self.order + form, self.message, first)

    def doubles(self, what: str) -> tuple[int, ...]:
        """Skip a sequence of float64; return the position of each value."""
        count = self.count(what)
        if not count:
            return ()
        if 8 * count > len(self.message):
            raise MessageError(f"ends inside {what}")
        first = self.skip(8 * count, what, 8)
        return tuple(range(first, first + 8 * count, 8))

    def header(self) -> int:
        """Skip a ``std_msgs/Header``; return the position of its stamp."""
        if not self.cdr:
            self.skip(4, "header.seq")
        stamp_at = self.skip(8, "header.stamp")
        self.text("header.frame_id")
        return stamp_at

    def names(self, what: str = "a joint's name") -> list[str]:
        """Read a sequence of strings, at most as many as a robot may have joints."""
        count = self.count("name")
        if count > limits.MCAP.joints_count:
            raise MessageError(f"{count} joints, more than {limits.MCAP.joints_count}")
        return [self.text(what) for _ in range(count)]

    def end(self) -> None:
        """Check that only padding follows."""
        if len(self.message) - self.at > 7:
            raise MessageError(f"{len(self.message) - self.at} bytes left over")

    def layout(
        self, names: list[str], stamp_at: int | None, values_at: Mapping[str, tuple[int, ...]]
    ) -> Layout:
        """Return the layout of the fields read so far."""
        check_names(names)
        filled = {}
        for quantity, at in values_at.items():
            if not at:
                continue
            if len(at) != len(names):
                raise MessageError(f"{len(at)} values of {quantity} for {len(names)} joints")
            filled[quantity] = at
        return Layout(tuple(names), self.order, stamp_at, filled, tuple(self.structure))

    def _keep(self, first: int, last: int) -> None:
        if self.structure and self.structure[-1][1] == first:
            self.structure[-1] = (self.structure[-1][0], last)
        else:
            self.structure.append((first, last))


def check_names(names: list[str]) -> None:
    """Raise an error for missing, repeated, empty or unprintable joint names.

    Raises:
        MessageError: the names are unusable.
    """
    if not names:
        raise MessageError("no joint names")
    if len(set(names)) != len(names):
        raise MessageError("a joint occurs twice")
    if not all(name and name.isprintable() for name in names):
        raise MessageError("a joint's name is empty or unprintable")


def decode(
    data: bytes, starts: Integers, sizes: Integers, layout_of: LayoutOf, encoding: Encoding
) -> Iterator[Decoded]:
    """Decode messages in ``data``, all messages of one layout at a time.

    Args:
        data: decompressed content of a chunk.
        starts: (n,) byte position of each message.
        sizes: (n,) length of each message, bytes.
        layout_of: function that determines the layout of one message.
        encoding: encoding of all messages.

    Yields:
        a batch, or the index of a message that cannot be decoded and the reason.
    """
    for size in np.unique(sizes):
        rows = np.flatnonzero(sizes == size)
        yield from _decode_group(data, starts, rows, int(size), layout_of, encoding)


def _decode_group(
    data: bytes,
    starts: Integers,
    rows: Integers,
    size: int,
    layout_of: LayoutOf,
    encoding: Encoding,
) -> Iterator[Decoded]:
    if size == 0:
        for row in rows:
            yield int(row), MessageError("empty message")
        return
    # Overlapping windows, one per byte: indexing rows copies whole messages.
    windows = np.ndarray((len(data) - size + 1,), dtype=f"V{size}", buffer=data, strides=(1,))
    for _ in range(_LAYOUTS_PER_GROUP):
        if not rows.size:
            return
        start = int(starts[rows[0]])
        try:
            layout = layout_of(Cursor(data[start : start + size], encoding))
        except MessageError as error:
            yield int(rows[0]), error
            rows = rows[1:]
            continue
        messages = windows[starts[rows]]
        same = _same_layout(messages, layout, size)
        yield _batch(rows[same], messages[same], layout)
        rows = rows[~same]
    for row, start in zip(rows.tolist(), starts[rows].tolist(), strict=True):
        try:
            layout = layout_of(Cursor(data[start : start + size], encoding))
        except MessageError as error:
            yield row, error
        else:
            yield _batch(np.array([row]), windows[[start]], layout)


def _same_layout(messages: NDArray[np.void], layout: Layout, size: int) -> NDArray[np.bool_]:
    table = messages.view(np.uint8).reshape(len(messages), size)
    same = np.ones(len(messages), dtype=bool)
    for first, last in layout.structure:
        same &= (table[:, first:last] == table[0, first:last]).all(axis=1)
    return same


def _batch(rows: Integers, messages: NDArray[np.void], layout: Layout) -> Batch:
    count = len(messages)

    def read(form: str, at: int, shape: tuple[int, ...] = ()) -> NDArray[Any]:
        kind: Any = (layout.order + form, shape) if shape else layout.order + form
        field = np.dtype(
            {"names": ["x"], "formats": [kind], "offsets": [at], "itemsize": messages.itemsize}
        )
        found: NDArray[Any] = messages.view(field)["x"]
        return found

    stamp, bad_stamp = np.zeros(count, np.int64), 0
    if layout.stamp_at is not None:
        nanosec = read("u4", layout.stamp_at + 4).astype(np.int64)
        stamp = read("i4", layout.stamp_at).astype(np.int64) * 1_000_000_000 + nanosec
        bad_stamp = int((nanosec >= 1_000_000_000).sum())
    values: dict[str, Floats | None] = dict.fromkeys(QUANTITIES)
    for quantity, at in layout.values_at.items():
        if at == tuple(range(at[0], at[0] + 8 * len(at), 8)) and at[0] >= 0:
            values[quantity] = read("f8", at[0], (len(at),)).astype(np.float64)
        else:
            table = np.full((count, len(at)), np.nan)
            for column, place in enumerate(at):
                if place >= 0:
                    table[:, column] = read("f8", place)
            values[quantity] = table
    return Batch(rows, layout.names, stamp, bad_stamp, values)
