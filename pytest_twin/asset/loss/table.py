"""Rows of the matrix, and their tolerances."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.asset.loss.matrix import Item, Row, Verdict

Vector = NDArray[np.float64]

EXACT = 1e-9
"""m, rad, or relative: the largest difference that counts as kept."""
SINGLE = 2e-6
"""The same for values in single precision: they count as changed, and are no fault."""
CLOSE = 1e-5
"""m: for corners of shapes, whose vertices simulators store in single precision."""
_MOST_ITEMS = 200


def table(
    feature: str,
    before: str,
    after: str,
    comparison: str,
    items: list[Item],
    *,
    empty: bool = False,
    critical: bool = False,
) -> Row:
    """A row of named elements: kept where no item differs."""
    verdict: Verdict = "kept"
    if empty:
        verdict = "none"
    elif any(item.verdict == "lost" for item in items):
        verdict = "lost"
    elif items:
        verdict = "changed"
    return Row(
        feature,
        verdict,
        before,
        after,
        comparison,
        items=tuple(items[:_MOST_ITEMS]),
        critical=critical,
    )


def stated(
    feature: str, before: Mapping[str, str], after: Mapping[str, str], comparison: str
) -> Row:
    """A row of values that have to be equal on both sides."""
    items = [
        Item(name, "lost" if name not in after else "changed", before.get(name), after.get(name))
        for name in sorted(set(before) | set(after))
        if before.get(name) != after.get(name)
    ]
    return table(
        feature, some(before), some(after), comparison, items, empty=not before and not after
    )


def present(
    feature: str, before: Mapping[str, str], after: Mapping[str, str], comparison: str
) -> Row:
    """A row of elements that the target has or lacks, whatever their values."""
    items = [Item(name, "lost", before[name], None) for name in sorted(before) if name not in after]
    return table(feature, some(before), some(after), comparison, items, empty=not before)


def some(names: Iterable[str]) -> str:
    """Their count, and the first four names."""
    listed = sorted(names)
    if not listed:
        return "none"
    shown = ", ".join(listed[:4]) + (", ..." if len(listed) > 4 else "")
    return f"{len(listed)}: {shown}"


def numbers(values: Any) -> str:
    """Numbers with six significant digits."""
    return " ".join(f"{float(value):.6g}" for value in np.ravel(np.asarray(values)))


def most(values: Vector) -> float:
    """The largest magnitude, 0 of an empty array."""
    return float(np.abs(values).max()) if values.size else 0.0


def alike(before: Any, after: Any) -> bool:
    """Whether two values agree to ``EXACT``, or both are None."""
    if before is None or after is None:
        return before is after
    return bool(np.allclose(before, after, rtol=EXACT, atol=EXACT))
