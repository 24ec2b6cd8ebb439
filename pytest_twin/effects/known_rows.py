"""What rows came to that were simulated before: a search asks for many of them again.

A fit begins where another ended, a rival is judged that was fitted, the same hypothesis is held
against other recordings. What a row's sensors read follows from its segment and the parameters of
its effects alone, so it is simulated once and kept, as long as there is room.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue
from pytest_twin.effects.acting import EffectValues, there
from pytest_twin.effects.segment import Predicted, Segment

_MOST_BYTES = 256_000_000

RowKey = tuple[int, bytes]
"""A segment, by its identity, and the parameters of the effects that a row has."""


def row_keys(segments: Sequence[Segment], values: EffectValues) -> list[RowKey]:
    """What tells rows apart: each its segment under its row of ``values``."""
    count = len(segments)
    parts: list[list[bytes]] = [[] for _ in range(count)]
    for name, given in sorted(values.items()):
        acts = np.flatnonzero(there(catalogue()[name], given).any(axis=1))
        if not acts.size:
            continue
        label = name.encode() + b"\0"
        numbers = np.stack([given[p][acts] for p in sorted(given)], axis=1)
        for row, of_row in zip(acts.tolist(), numbers, strict=True):
            parts[row] += (label, of_row.tobytes())
    return [(id(s), b"".join(own)) for s, own in zip(segments, parts, strict=True)]


class KnownRows:
    """Predictions by what tells their rows apart; those that were asked for last."""

    def __init__(self, most_bytes: int = _MOST_BYTES) -> None:
        self._most_bytes, self._bytes = most_bytes, 0
        # The segment stays alive with what is known of it: its identity is part of the key.
        self._known: OrderedDict[RowKey, tuple[Segment, Predicted]] = OrderedDict()

    def get(self, key: RowKey) -> Predicted | None:
        """What a row came to, None where that is not known."""
        found = self._known.get(key)
        if found is None:
            return None
        self._known.move_to_end(key)
        return found[1]

    def keep(self, key: RowKey, segment: Segment, predicted: Predicted) -> Predicted:
        """Keep what a row came to, and return it: on its own, and no longer to be written to."""
        kept = Predicted(*map(_on_its_own, _arrays(predicted)))
        self._known[key] = segment, kept
        self._bytes += _size(kept)
        while self._bytes > self._most_bytes and len(self._known) > 1:
            _, (_, oldest) = self._known.popitem(last=False)
            self._bytes -= _size(oldest)
        return kept


def _arrays(predicted: Predicted) -> tuple[FloatArray, FloatArray, FloatArray]:
    return predicted.position, predicted.velocity, predicted.effort


def _on_its_own(array: FloatArray) -> FloatArray:
    """The array without the batch that it may be a view of."""
    own = array.copy()
    own.flags.writeable = False
    return own


def _size(predicted: Predicted) -> int:
    return sum(array.nbytes for array in _arrays(predicted))
