"""Differences between the authoritative realization of a golden and the other realizations.

Each difference is reported separately; nothing is averaged over simulators. This module reads no
files.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from pytest_twin.golden import Golden
from pytest_twin.outcome import Measure, Outcome
from pytest_twin.report.text import number, quantity

_MAX_LINES = 40
"""Largest number of printed comparisons."""
_EQUAL_FRACTION = 1e-3
"""Fraction of the tolerance below which results count as equal; rounding errors reach 1e-11."""


def recorded_without_authority(goldens: Iterable[Golden]) -> Iterator[str]:
    """Yield one line for each golden that was recorded on a realization without authority."""
    for golden in goldens:
        recorded = golden.provenance
        authority = golden.realizations[0]
        if recorded is not None and recorded.realization != authority:
            yield (
                f"{golden.path}: recorded on {recorded.realization!r}, and {authority!r} is "
                "authoritative for it (expected values of that: run pytest --twin-update)"
            )


def difference_lines(
    goldens: Sequence[Golden], outcomes: Mapping[str, Outcome], simulators: Mapping[str, str]
) -> list[str]:
    """Describe the difference of each other realization from the authoritative one, a line each.

    Args:
        goldens: their first realization is the authoritative one.
        outcomes: ``golden@realization`` -> outcome.
        simulators: realization -> simulator.
    """
    lines: list[str] = []
    for golden in goldens:
        authority, *others = golden.realizations
        own = outcomes.get(f"{golden.id}@{authority}")
        for name in others:
            other = outcomes.get(f"{golden.id}@{name}")
            if own is None or other is None:
                continue
            title = f"{name} ({simulators[name]}) against {authority} ({simulators[authority]})"
            lines.append(f"{golden.id}: {title}, which is authoritative: {_difference(own, other)}")
    if len(lines) > _MAX_LINES:
        lines[_MAX_LINES:] = [f"and {len(lines) - _MAX_LINES} more comparisons"]
    return lines


def _difference(own: Outcome, other: Outcome) -> str:
    for outcome in (own, other):
        if outcome.status == "error":
            return f"no comparison, {outcome.realization}: {outcome.error}"
    theirs = {(m.name, m.subject, m.against): m for m in other.measures}
    pairs = [
        (mine, theirs[key])
        for mine in own.measures
        if (key := (mine.name, mine.subject, mine.against)) in theirs
    ]
    if not pairs:
        return "no measure in common"
    mine, its = max(pairs, key=lambda pair: _fraction_of_tolerance(*pair))
    if _fraction_of_tolerance(mine, its) < _EQUAL_FRACTION:
        return f"the same to within {number(100.0 * _EQUAL_FRACTION)} % of the tolerance"
    found, own_found = _compared_value(its), _compared_value(mine)
    difference = abs(found - own_found)
    deviation = "" if mine.time is None else " off by"
    return (
        f"{mine.name} of {mine.subject}{deviation} {quantity(found, its.unit)} and "
        f"{quantity(own_found, mine.unit)}, {quantity(difference, mine.unit)} apart, "
        f"{number(100.0 * _fraction_of_tolerance(mine, its))} % of the tolerance "
        f"(largest of {len(pairs)})"
    )


def _compared_value(measure: Measure) -> float:
    """The measured value; for a series its error, because the worst samples differ in time."""
    return measure.measured if measure.time is None else measure.error


def _fraction_of_tolerance(mine: Measure, its: Measure) -> float:
    """Difference of two measures as a multiple of the tolerance."""
    difference = abs(_compared_value(its) - _compared_value(mine))
    if mine.tolerance > 0.0:
        return difference / mine.tolerance
    return 0.0 if difference == 0.0 else float("inf")
