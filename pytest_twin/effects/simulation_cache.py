"""A cache of simulations, because a search requests many of them repeatedly.

A fit starts at the result of another one, and the same hypothesis is evaluated several times. A
simulation depends only on its segment and the parameters of its effects.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue
from pytest_twin.effects.active_effects import EffectValues, acts_at
from pytest_twin.effects.segment import Predicted, Segment

_MAX_BYTES = 256_000_000
"""Memory limit of the cache."""

RowKey = tuple[int, bytes]
"""Identity of a segment, and the parameters of the effects of a row."""


def row_keys(segments: Sequence[Segment], values: EffectValues) -> list[RowKey]:
    """Return the cache keys of rows: each has one segment and one row of ``values``."""
    count = len(segments)
    parts: list[list[bytes]] = [[] for _ in range(count)]
    for name, given in sorted(values.items()):
        acts = np.flatnonzero(acts_at(catalogue()[name], given).any(axis=1))
        if not acts.size:
            continue
        label = name.encode() + b"\0"
        numbers = np.stack([given[p][acts] for p in sorted(given)], axis=1)
        for row, of_row in zip(acts.tolist(), numbers, strict=True):
            parts[row] += (label, of_row.tobytes())
    return [(id(s), b"".join(own)) for s, own in zip(segments, parts, strict=True)]


class SimulationCache:
    """A least-recently-used cache of predictions."""

    def __init__(self, most_bytes: int = _MAX_BYTES) -> None:
        self._most_bytes, self._bytes = most_bytes, 0
        # Keep the segment alive: its identity is part of the key.
        self._entries: OrderedDict[RowKey, tuple[Segment, Predicted]] = OrderedDict()

    def get(self, key: RowKey) -> Predicted | None:
        """Return the prediction of a row, or None if it is not in the cache."""
        found = self._entries.get(key)
        if found is None:
            return None
        self._entries.move_to_end(key)
        return found[1]

    def store(self, key: RowKey, segment: Segment, predicted: Predicted) -> Predicted:
        """Store a read-only copy of a prediction and return it."""
        kept = Predicted(*map(_read_only_copy, _arrays(predicted)))
        self._entries[key] = segment, kept
        self._bytes += _size(kept)
        while self._bytes > self._most_bytes and len(self._entries) > 1:
            _, (_, oldest) = self._entries.popitem(last=False)
            self._bytes -= _size(oldest)
        return kept


def _arrays(predicted: Predicted) -> tuple[FloatArray, FloatArray, FloatArray]:
    return predicted.position, predicted.velocity, predicted.effort


def _read_only_copy(array: FloatArray) -> FloatArray:
    """Return a read-only copy, which does not keep a whole batch in memory."""
    own = array.copy()
    own.flags.writeable = False
    return own


def _size(predicted: Predicted) -> int:
    return sum(array.nbytes for array in _arrays(predicted))
