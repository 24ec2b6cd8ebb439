"""Build rows of the loss matrix; tolerances of the comparison."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.asset.loss.matrix import Item, Row, Verdict

Vector = NDArray[np.float64]

EXACT = 1e-9
"""Largest difference that counts as kept: m, rad, or relative."""
SINGLE = 2e-6
"""Largest difference explained by single precision: changed, but not critical."""
CLOSE = 1e-5
"""Tolerance for corners of shapes, m: simulators store vertices in single precision."""
_MOST_ITEMS = 200
"""Largest number of elements that a row lists."""


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
    """Build a row of named elements, which is kept if no item differs."""
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


def equality_row(
    feature: str, before: Mapping[str, str], after: Mapping[str, str], comparison: str
) -> Row:
    """Build a row of values that have to be equal before and after the conversion."""
    items = [
        Item(name, "lost" if name not in after else "changed", before.get(name), after.get(name))
        for name in sorted(set(before) | set(after))
        if before.get(name) != after.get(name)
    ]
    return table(
        feature,
        count_and_names(before),
        count_and_names(after),
        comparison,
        items,
        empty=not before and not after,
    )


def presence_row(
    feature: str, before: Mapping[str, str], after: Mapping[str, str], comparison: str
) -> Row:
    """Build a row of elements that exist or are missing in the target, regardless of value."""
    items = [Item(name, "lost", before[name], None) for name in sorted(before) if name not in after]
    return table(
        feature,
        count_and_names(before),
        count_and_names(after),
        comparison,
        items,
        empty=not before,
    )


def count_and_names(names: Iterable[str]) -> str:
    """Return the number of names and the first four."""
    listed = sorted(names)
    if not listed:
        return "none"
    shown = ", ".join(listed[:4]) + (", ..." if len(listed) > 4 else "")
    return f"{len(listed)}: {shown}"


def format_numbers(values: Any) -> str:
    """Format numbers with six significant digits."""
    return " ".join(f"{float(value):.6g}" for value in np.ravel(np.asarray(values)))


def largest_magnitude(values: Vector) -> float:
    """Return the largest magnitude, 0 for an empty array."""
    return float(np.abs(values).max()) if values.size else 0.0


def are_equal(before: Any, after: Any) -> bool:
    """Whether two values are equal within ``EXACT``, or both are None."""
    if before is None or after is None:
        return before is after
    return bool(np.allclose(before, after, rtol=EXACT, atol=EXACT))
