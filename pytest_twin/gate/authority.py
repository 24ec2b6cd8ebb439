"""Results of a golden on simulators that are not authoritative for it. Pure.

Each difference is reported alone; nothing is averaged over simulators.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from pytest_twin.golden import Golden
from pytest_twin.outcome import Measure, Outcome
from pytest_twin.report.text import number, quantity

_MOST_LINES = 40
_AGREES = 1e-3
"""Share of the tolerance below which realizations agree; rounding alone reaches 1e-11."""


def recorded_elsewhere(goldens: Iterable[Golden]) -> Iterator[str]:
    """One line for each golden whose values come from a realization without authority over it."""
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
    """How far the other simulators of each golden are from the authoritative one.

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
            lines.append(f"{golden.id}: {title}, which is authoritative: {_between(own, other)}")
    if len(lines) > _MOST_LINES:
        lines[_MOST_LINES:] = [f"and {len(lines) - _MOST_LINES} more comparisons"]
    return lines


def _between(own: Outcome, other: Outcome) -> str:
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
    mine, its = max(pairs, key=lambda pair: _share(*pair))
    if _share(mine, its) < _AGREES:
        return f"the same to within {number(100.0 * _AGREES)} % of the tolerance"
    found, own_found = _compared(its), _compared(mine)
    difference = abs(found - own_found)
    deviation = "" if mine.time is None else " off by"
    return (
        f"{mine.name} of {mine.subject}{deviation} {quantity(found, its.unit)} and "
        f"{quantity(own_found, mine.unit)}, {quantity(difference, mine.unit)} apart, "
        f"{number(100.0 * _share(mine, its))} % of the tolerance (largest of {len(pairs)})"
    )


def _compared(measure: Measure) -> float:
    """The value, or the error of a series: its worst sample is at another time in each."""
    return measure.measured if measure.time is None else measure.error


def _share(mine: Measure, its: Measure) -> float:
    """The difference in multiples of the tolerance."""
    difference = abs(_compared(its) - _compared(mine))
    if mine.tolerance > 0.0:
        return difference / mine.tolerance
    return 0.0 if difference == 0.0 else float("inf")
