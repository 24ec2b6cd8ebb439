"""Rows of the matrix, and the numbers that decide them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.asset.loss.matrix import Item, Row, Verdict

Vector = NDArray[np.float64]

EXACT = 1e-9
"""m, rad, and share of a magnitude: up to here a number is kept."""
SINGLE = 2e-6
"""The same, for what a file holds with single precision: changed, and no fault."""
CLOSE = 1e-5
"""m: corners of shapes, whose vertices every simulator holds with single precision."""
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
    lost: bool = False,
) -> Row:
    """A row of named things: kept where no item stands out."""
    verdict: Verdict = "kept"
    if empty:
        verdict = "none"
    elif lost or any(item.verdict == "lost" for item in items):
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
    """A row of words that both sides have to hold alike."""
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
    """What the source states and the target has, or has not, whatever it is made of."""
    items = [Item(name, "lost", before[name], None) for name in sorted(before) if name not in after]
    return table(feature, some(before), some(after), comparison, items, empty=not before)


def some(names: Iterable[str]) -> str:
    """How many there are, and the first of them."""
    listed = sorted(names)
    if not listed:
        return "none"
    shown = ", ".join(listed[:4]) + (", ..." if len(listed) > 4 else "")
    return f"{len(listed)}: {shown}"


def numbers(values: Any) -> str:
    """Numbers with six digits, as people read them."""
    return " ".join(f"{float(value):.6g}" for value in np.ravel(np.asarray(values)))


def most(values: Vector) -> float:
    """The largest magnitude, 0 of none."""
    return float(np.abs(values).max()) if values.size else 0.0


def alike(before: Any, after: Any) -> bool:
    """Whether two values agree to ``EXACT``, or neither is there."""
    if before is None or after is None:
        return before is after
    return bool(np.allclose(before, after, rtol=EXACT, atol=EXACT))
