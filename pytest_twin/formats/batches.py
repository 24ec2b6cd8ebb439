"""Merge batches of messages into one table with a row per message and a column per joint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pytest_twin.formats.recording import Notes
from pytest_twin.formats.ros_serialization import Batch, Floats, Integers


def table_of(
    batches: Sequence[Batch], name: str, names: tuple[str, ...], order: Integers
) -> Floats | None:
    """Return one quantity as (n, j); NaN where a message lacks a joint, None if all are empty.

    Args:
        name: the quantity, such as ``position``.
        names: joint of each column.
        order: (n,) permutation from the order of the batches to the order of the file.
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


def named_joints(
    batches: Sequence[Batch], names: tuple[str, ...], order: Integers
) -> NDArray[np.bool_]:
    """Return which joints each message names, as (n, j) booleans."""
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
    """Note the messages in which a named joint has an empty or non-finite value."""
    table = tables[name]
    if table is None:
        return
    # Joints with different control modes each fill one field and are NaN throughout in the others.
    others = [t for key, t in tables.items() if key != name and t is not None]
    elsewhere = [np.isfinite(t).any(axis=0) for t in others]
    unused = np.isnan(table).all(axis=0) & np.any([np.zeros(len(names), bool), *elsewhere], 0)
    bad = carried & ~unused & ~np.isfinite(table)
    if not bad.any():
        return
    # An empty field is read as a row of NaN.
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
