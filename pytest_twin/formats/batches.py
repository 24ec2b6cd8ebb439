"""Batches of messages as one table of joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pytest_twin.formats.recording import Notes
from pytest_twin.formats.serialized import Batch, Floats, Integers


def table_of(
    batches: Sequence[Batch], name: str, names: tuple[str, ...], order: Integers
) -> Floats | None:
    """(n, j) of one quantity, NaN where a message does not carry a joint; None where all are empty.

    Args:
        batches: of one topic.
        name: the quantity.
        names: joints of the table.
        order: (n,) from the messages as batches have them to the order of the file.
    """
    if all(batch.values[name] is None for batch in batches):
        return None
    column = {joint: at for at, joint in enumerate(names)}
    parts = []
    for batch in batches:
        values = batch.values[name]
        if values is None or batch.names != names:
            whole = np.full((len(batch.rows), len(names)), np.nan)
            if values is not None:
                whole[:, [column[joint] for joint in batch.names]] = values
            values = whole
        parts.append(values)
    table = np.concatenate(parts)
    in_order = bool((np.diff(order) == 1).all())
    return table if in_order else table[order]


def carried_by(
    batches: Sequence[Batch], names: tuple[str, ...], order: Integers
) -> NDArray[np.bool_]:
    """(n, j) which joints each message names."""
    parts = []
    for batch in batches:
        named = set(batch.names)
        parts.append(np.tile([joint in named for joint in names], (len(batch.rows), 1)))
    table: NDArray[np.bool_] = np.concatenate(parts)[order]
    return table


def note_not_finite(
    notes: Notes,
    topic: str,
    name: str,
    tables: Mapping[str, Floats | None],
    names: tuple[str, ...],
    carried: NDArray[np.bool_],
) -> None:
    """Note where a quantity of joints that messages name is empty or not finite."""
    table = tables[name]
    if table is None:
        return
    # Of joints with different modes each fills one field and has NaN throughout in the others.
    others = [t for key, t in tables.items() if key != name and t is not None]
    elsewhere = [np.isfinite(t).any(axis=0) for t in others]
    unused = np.isnan(table).all(axis=0) & np.any([np.zeros(len(names), bool), *elsewhere], 0)
    bad = carried & ~unused & ~np.isfinite(table)
    if not bad.any():
        return
    # A whole row of NaN is how an empty field reads.
    empty = np.isnan(table).all(axis=1)
    odd = np.flatnonzero(bad.any(axis=1) & ~empty)
    if odd.size:
        joint = names[int(np.flatnonzero(bad[odd[0]])[0])]
        notes.add(
            topic,
            f"{name} is not finite in {odd.size} messages, first message {int(odd[0])}, "
            f"joint {joint!r}",
        )
    if empty.any():
        notes.add(
            topic,
            f"{name} is empty in {int(empty.sum())} of {len(table)} messages, first message "
            f"{int(np.flatnonzero(empty)[0])}",
        )
