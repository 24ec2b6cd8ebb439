"""Compare given randomization ranges with measured ones, as sentences."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtri

from pytest_twin.errors import FormatError
from pytest_twin.ranges.quantities import Quantity
from pytest_twin.ranges.range_files import Term
from pytest_twin.ranges_spec import TrialGroup

_UNITS = {"temperature": "deg C", "load": "kg"}
_SAME = 0.1
"""Relative difference below which two widths are called equal."""
_LONGEST_PATTERN, _MOST_REPEATED = 256, 4
"""Limits of a regular expression, in characters and repetitions: others may take long to match."""


def compare(
    path: Path,
    terms: Sequence[Term],
    skipped: Sequence[str],
    measured: Sequence[Quantity],
    groups: Sequence[TrialGroup],
    share: float,
) -> dict[str, Any]:
    """Return ``against`` of ``ranges.json``: each given range with the measured one.

    Args:
        path: path of the file with the given ranges.
        terms: randomization terms of the file.
        skipped: parts of the file that are not compared.
        groups: trials under different conditions, whose estimates should lie in a range.
        share: probability of the central interval that represents a normal distribution.

    Raises:
        FormatError: a pattern of names is no regular expression, or its evaluation could take very
            long.
    """
    entries: list[dict[str, Any]] = []
    unmatched = list(skipped)
    for term in terms:
        own = [one for one in measured if _matches(term, one, path)]
        if not own:
            where = "" if term.where == term.kinds[0] else f"{term.where}: "
            unmatched.append(f"{where}{', '.join(term.kinds)}: nothing measured it")
        entries += [_entry(term, one, groups, share) for one in own]
    given = {entry["parameter"] for entry in entries}
    left = [one for one in measured if one.name not in given and "inertia" not in one.kind
            and "com_" not in one.kind]  # fmt: skip
    return {
        "file": path.name,
        "entries": entries,
        "not_read": unmatched,
        "not_given": [f"{one.name}, measured {_interval(one.range, one.unit)}" for one in left],
    }


def _matches(term: Term, one: Quantity, path: Path) -> bool:
    if term.names is None and one.name in term.kinds:
        return True
    if one.kind not in term.kinds:
        return False
    return term.names is None or any(_fits(p, one.owner, path) for p in term.names)


def _fits(pattern: str, name: str, path: Path) -> bool:
    """Whether a pattern of names (a regular expression, as in both simulators) matches a name."""
    if pattern == name:
        return True
    # Nested repetitions can take exponential time; only simple patterns are evaluated.
    often = len(re.findall(r"[*+{]", pattern))
    if len(pattern) > _LONGEST_PATTERN or often > _MOST_REPEATED or ")" in pattern:
        raise FormatError(
            "a pattern of names that is too complex to evaluate safely",
            path=path,
            value=pattern,
            expected="names, or .* between parts of names",
        )
    try:
        return re.fullmatch(pattern, name) is not None
    except re.error:
        raise FormatError("no pattern of names", path=path, value=pattern,
                          expected="names, or regular expressions")  from None  # fmt: skip


def _entry(term: Term, one: Quantity, groups: Sequence[TrialGroup], share: float) -> dict[str, Any]:
    low, high = _given_range(term, one.nominal, share)
    measured = one.range[1] - one.range[0]
    times = (high - low) / measured if measured > 0.0 else None
    inside = float(np.mean((one.draws >= low) & (one.draws <= high)))
    lost = [f"{100.0 * (1.0 - inside):.0f} % of it"] if inside < share else []
    lost += _excluded_measurements(one, groups, low, high)
    words = (
        f"{one.name}: the given range {_interval((low, high), one.unit)} is {_times(times)} what "
        f"was measured ({_interval(one.range, one.unit)})"
    )
    words += f" and leaves out {', and '.join(lost)}" if lost else ""
    return {
        "parameter": one.name,
        "kind": one.kind,
        "given": [low, high],
        "measured": list(one.range),
        "nominal": one.nominal,
        "unit": one.unit,
        "times": times,
        "inside": inside,
        "words": words,
        "where": term.where,
    }


def _given_range(term: Term, nominal: float, share: float) -> tuple[float, float]:
    """Return the range that a term gives for a nominal value."""
    first, second = term.numbers
    if term.distribution == "gaussian":
        reach = float(ndtri(0.5 + 0.5 * share)) * abs(second)
        first, second = first - reach, first + reach
    if term.operation == "scale":
        first, second = first * nominal, second * nominal
    elif term.operation == "add":
        first, second = first + nominal, second + nominal
    # A negative nominal value reverses the ends of a scale.
    return min(first, second), max(first, second)


def _excluded_measurements(
    one: Quantity, groups: Sequence[TrialGroup], low: float, high: float
) -> Iterator[str]:
    for group in groups:
        value = group.record.values.get(one.name)
        if value is not None and not low <= value <= high:
            place = _condition(group.conditions, group)
            yield f"what was measured {place} ({value:.3g} {one.unit})"


def _condition(conditions: Mapping[str, float], group: TrialGroup) -> str:
    if not conditions:
        return f"in {group.record.id}"
    return "at " + ", ".join(
        f"{value:g} {_UNITS[name]}" + (f" {name}" if name == "load" else "")
        for name, value in conditions.items()
    )


def _times(times: float | None) -> str:
    if times is None:
        return "against one value,"
    if abs(times - 1.0) <= _SAME:
        return "as wide as"
    return f"{times:.2g} times as wide as"


def _interval(ends: Sequence[float], unit: str) -> str:
    return f"{ends[0]:.3g} to {ends[1]:.3g}" + ("" if unit == "1" else f" {unit}")
