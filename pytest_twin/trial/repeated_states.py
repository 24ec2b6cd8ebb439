"""Recognise states that a node published again before there was a new sample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.formats.ros_serialization import Floats, Integers
from pytest_twin.recording_options import CommandMode

# Messages per sample below which nothing is repeated.
_FEWEST_REPEATS = 1.5
# Changes that show how often a sample is repeated.
_FEWEST_CHANGES = 20
# Fraction of intervals between changes that are as long as the usual one, within one message.
_REGULAR = 0.95
# Multiple of the usual interval beyond which the joints rest.
_REST = 1.75
# Smallest spread of the changes, relative to their median. An encoder that turns slowly changes at
# regular intervals too, but always by one step.
_SPREAD = 0.1


@dataclass(frozen=True)
class Samples:
    """Messages that are samples of their own.

    Attributes:
        rows: (k,) indices of these messages.
        repeats: messages per sample; 1 if none is repeated.
    """

    rows: NDArray[np.int64]
    repeats: float

    def note(self, topic: str, messages: int) -> list[str]:
        """A note if messages were repeated; ``messages`` is their number."""
        if len(self.rows) == messages:
            return []
        return [
            f"{topic}: {messages} messages repeat {len(self.rows)} samples, each about "
            f"{self.repeats:.3g} times: the repeated ones are left out"
        ]


def own_samples(stamp: Integers, fields: Mapping[CommandMode, Floats | None]) -> Samples:
    """Return the messages that have a new sample.

    A repeater sends each sample several times: while the joints move, values change at every k-th
    message, by different amounts. A message with the stamp and the values of the one before is
    never a sample. At rest, every k-th message is kept.

    Args:
        stamp: (n,) ns, not decreasing.
        fields: quantity -> (n, j), NaN where a message does not carry a joint; or None.
    """
    tables = [table for table in fields.values() if table is not None]
    everything = np.arange(len(stamp))
    if not tables or len(stamp) < 2:
        return Samples(everything, 1.0)
    values = np.concatenate(tables, axis=1)
    before, after = values[:-1], values[1:]
    equal = ((before == after) | (np.isnan(before) & np.isnan(after))).all(axis=1)
    twice = equal & (np.diff(stamp) == 0)
    rows = everything[np.append(True, ~twice)]
    changes = np.flatnonzero(~equal) + 1
    # Rows of the messages that are kept so far.
    places = np.searchsorted(rows, changes)
    with np.errstate(invalid="ignore"):
        repeats = _repeats(places, values[changes] - values[changes - 1])
    if repeats <= 1.0:
        return Samples(rows, len(everything) / len(rows))
    is_sample = np.zeros(len(rows), dtype=bool)
    is_sample[places] = True
    for first, end in zip(np.append(0, places), np.append(places, len(rows)), strict=True):
        at_rest = np.rint(np.arange(first, end - 0.5 * repeats, repeats)).astype(np.int64)
        is_sample[at_rest[at_rest < end]] = True
    is_sample[0] = True
    return Samples(rows[is_sample], len(everything) / int(is_sample.sum()))


def _repeats(places: NDArray[np.int64], changes: Floats) -> float:
    """Messages per sample; 1 if none is repeated.

    Args:
        places: (c,) indices of the messages whose values differ from those before.
        changes: (c, v) these differences.
    """
    if len(places) < _FEWEST_CHANGES:
        return 1.0
    intervals = np.diff(places)
    usual = float(np.median(intervals))
    moving = intervals[intervals <= _REST * usual]
    repeats = float(moving.mean())
    regular = np.abs(moving - repeats) < 1.0
    if repeats < _FEWEST_REPEATS or regular.mean() < _REGULAR:
        return 1.0
    size = np.abs(changes)
    for column in size.T:
        moved = column[np.isfinite(column) & (column > 0.0)]
        if len(moved) >= _FEWEST_CHANGES and np.std(moved) > _SPREAD * np.median(moved):
            return repeats
    return 1.0
