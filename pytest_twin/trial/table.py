"""Convert the messages of a topic to a table, sorted by stamp and merged per stamp."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray


def stamp_order(stamp: NDArray[np.int64]) -> NDArray[np.int64]:
    """(n,) indices of the messages in stable order of their stamps."""
    return np.argsort(stamp, kind="stable")


@dataclass(frozen=True, slots=True)
class StateRows:
    """Table of states.

    Attributes:
        stamp: (n,) ns.
        fields: ``position``, ``velocity``, ``effort`` -> (n, j), or None.
        merged: number of messages that were merged with others of the same stamp.
    """

    stamp: NDArray[np.int64]
    fields: dict[str, FloatArray | None]
    merged: int


def merge_states(
    stamp: NDArray[np.int64], fields: dict[str, FloatArray | None], carried: NDArray[np.bool_]
) -> StateRows:
    """Merge messages with one stamp and different joints.

    Messages that contain the same joint are not merged.

    Args:
        stamp: (n,) ns, not decreasing.
        fields: each (n, j), or None.
        carried: (n, j) whether a message contains the position of a joint.
    """
    if not len(stamp) or carried.all():
        return StateRows(stamp, fields, 0)
    first = np.flatnonzero(np.append(True, np.diff(stamp) > 0))
    owner = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(stamp))))
    # The first message of a joint at a stamp goes into the first row of the stamp, the second into
    # a second row, and so on.
    counts = np.cumsum(carried, axis=0)
    before: NDArray[np.int64] = counts[first] - carried[first]
    level = ((counts - before[owner]) * carried).max(axis=1) - 1
    level = np.maximum(level, 0)
    key = owner * (int(level.max()) + 1) + level
    rows, of = np.unique(key, return_inverse=True)
    if len(rows) == len(stamp):
        return StateRows(stamp, fields, 0)
    merged: dict[str, FloatArray | None] = {}
    for name, table in fields.items():
        if table is None:
            merged[name] = None
            continue
        whole = np.full((len(rows), table.shape[1]), np.nan)
        row, column = np.nonzero(carried & ~np.isnan(table))
        whole[of[row], column] = table[row, column]
        merged[name] = whole
    together = np.zeros(len(rows), dtype=np.int64)
    np.add.at(together, of, 1)
    stamps = np.zeros(len(rows), dtype=np.int64)
    stamps[of] = stamp
    return StateRows(stamps, merged, int(together[together > 1].sum()))


def last_known(table: FloatArray) -> FloatArray:
    """(n, j) latest value of each joint at or before each row; NaN before its first value."""
    rows = np.where(np.isnan(table), -1, np.arange(len(table))[:, None])
    at = np.maximum.accumulate(rows, axis=0)
    known: FloatArray = np.where(
        at >= 0, np.take_along_axis(table, np.maximum(at, 0), axis=0), np.nan
    )
    return known


def kept_commands(table: FloatArray) -> FloatArray:
    """(n, j) commands in effect after each message.

    A joint that a message does not contain keeps its last command; before its first command, it has
    the first.
    """
    known = last_known(table)
    missing = np.isnan(known)
    if missing.any():
        first = np.argmax(~np.isnan(table), axis=0)
        known = np.where(missing, table[first, np.arange(table.shape[1])], known)
    return known
