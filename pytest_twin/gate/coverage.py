"""What the goldens of a release do not test, and what their results assume."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from pytest_twin.checks import check_of, kinds
from pytest_twin.errors import TwinError
from pytest_twin.outcome import Outcome
from pytest_twin.report.failure import what
from pytest_twin.words import counted, join_words

AUDIT = "asset"
"""Kind of golden that audits the model's file."""


@dataclass(frozen=True, slots=True)
class Gap:
    """Something that a release does not test.

    Attributes:
        name: a few words for a headline; empty where the headline does not need it.
        sentence: what is missing, and what adds it.
    """

    name: str
    sentence: str


def gaps(outcomes: Collection[Outcome]) -> tuple[Gap, ...]:
    """Return what the goldens of a release do not test: the model's file, motion over time."""
    gaps_found = []
    audited = {one.realization for one in outcomes if one.kind == AUDIT}
    unaudited = sorted({one.realization for one in outcomes} - audited)
    if not audited:
        gaps_found.append(
            Gap(
                "not audited",
                f"not audited: no golden of kind {AUDIT} checks the model's file; "
                "pytest --twin-update adds one for a URDF, MJCF or USD file",
            )
        )
    elif unaudited:
        gaps_found.append(
            Gap(
                f"{join_words(unaudited)} not audited",
                f"not audited: {join_words(unaudited)}; if its file is a URDF, MJCF or USD, add it "
                f"under realizations: of the golden of kind {AUDIT}",
            )
        )
    gaps_found += [
        Gap("critical findings of the audit", f"critical findings, advisory only: {what(one)}")
        for one in outcomes
        if one.kind == AUDIT and one.status == "failed" and one.criticality == "advisory"
    ]
    if outcomes and not any(_is_dynamic(one.kind) for one in outcomes if one.status == "passed"):
        dynamic = [kind for kind in kinds() if _is_dynamic(kind)]
        count = counted(len({one.golden for one in outcomes}), "golden")
        gaps_found.append(
            Gap(
                "no motion tested",
                f"thin: {count}, and none compares motion over time with a record "
                f"({', '.join(dynamic)})",
            )
        )
    return tuple(gaps_found)


def assumptions(outcomes: Collection[Outcome]) -> list[str]:
    """Return one line for each value that results assume because nothing states it."""
    several = len({one.realization for one in outcomes}) > 1
    lines = (
        f"assumed{f' on {one.realization}' if several else ''}: {note}"
        for one in outcomes
        for note in one.notes
    )
    return list(dict.fromkeys(lines))


def _is_dynamic(kind: str) -> bool:
    """Whether goldens of a kind compare motion over time; True where its package is missing."""
    try:
        return check_of(kind).dynamic
    except TwinError:
        return True
