"""Write the report of one run as a self-contained HTML file.

The page has no script and no external resource, and a content security policy forbids them,
because its names come from untrusted files.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pytest_twin.outcome import Measure, Reason, tolerance_ratio
from pytest_twin.report.failure import headline
from pytest_twin.report.model import Entry, Report, Verdict
from pytest_twin.report.page import Page, svg_uri
from pytest_twin.report.text import number, quantity, use

MAX_PLOT_BYTES = 32 * 2**20
"""Total size of the plots in a report, bytes; plots of failed goldens come first."""
MAX_MEASURES = 400
"""Largest number of measures for a golden; the worst are shown."""
MAX_ALL_MEASURES = 12_000
"""Largest number of measures for all goldens; beyond it each golden shows only its worst."""
MAX_CHANGES = 200
"""Largest number of reasons for stale goldens; the most frequent are shown."""
MAX_PARTS = 60
"""Largest number of parts listed for a golden."""
MAX_ALL_PARTS = 30_000
"""Largest number of parts listed for all goldens."""

_WORDS: Mapping[Verdict, str] = {
    "released": "Released",
    "holds": "Still holds",
    "refused": "Refused",
    "passed": "Passed",
    "failed": "Failed",
}
_ORDER = {"failed": 0, "error": 1, "passed": 2}
"""Status of a golden -> its rank in the table."""


@dataclass(frozen=True, slots=True)
class _Row:
    """An entry of the page."""

    entry: Entry
    anchor: str
    state: str
    headline: str
    measures: tuple[Measure, ...]
    measures_left_out: int
    used: float | None
    parts: tuple[str, ...]
    plot: str | None
    plot_left_out: bool


def render(report: Report) -> str:
    """Return the report as one HTML document."""
    rows = _rows(report.entries)
    ran = [row for row in rows if row.entry.release is None and not row.entry.not_run]
    not_run = [row for row in rows if row.entry.not_run]
    proven = [row for row in rows if row.entry.release is not None]
    return _PAGE.render(
        report=report,
        verdict=_WORDS[report.verdict],
        good=report.verdict in ("released", "holds", "passed"),
        failed=[row for row in ran if row.state != "passed"],
        passed=[row for row in ran if row.state == "passed"],
        not_run=not_run,
        proven=proven,
        counts=_counts(ran, not_run, proven),
        ids=list(_flatten(report.ids)),
        changes=_changes([*ran, *not_run]),
    )


def _rows(entries: Iterable[Entry]) -> list[_Row]:
    """Return rows, the worst first, with plots up to the size limit of the page."""

    def gravity(entry: Entry) -> tuple[int, int, float, str]:
        outcome = entry.outcome
        worst = outcome.worst
        used = 0.0 if worst is None else tolerance_ratio(worst)
        advisory = outcome.criticality != "critical"
        return (_ORDER[outcome.status], int(advisory), -used, outcome.key)

    plot_room, measure_room, part_room = MAX_PLOT_BYTES, MAX_ALL_MEASURES, MAX_ALL_PARTS
    rows = []
    for index, entry in enumerate(sorted(entries, key=gravity)):
        outcome = entry.outcome
        ordered = sorted(outcome.measures, key=tolerance_ratio, reverse=True)
        measures = tuple(ordered[: min(MAX_MEASURES, max(1, measure_room))])
        parts = tuple(sorted(entry.parts)[: min(MAX_PARTS, max(0, part_room))])
        measure_room -= len(measures)
        part_room -= len(parts)
        plot = None
        if entry.plot is not None and len(entry.plot) <= plot_room:
            plot_room -= len(entry.plot)
            plot = svg_uri(entry.plot)
        rows.append(
            _Row(
                entry=entry,
                anchor=f"g{index}",
                state=outcome.status,
                headline=headline(outcome),
                measures=measures,
                measures_left_out=len(ordered) - len(measures),
                used=tolerance_ratio(ordered[0]) if ordered else None,
                parts=parts,
                plot=plot,
                plot_left_out=entry.plot is not None and plot is None,
            )
        )
    return rows


def _counts(
    ran: Sequence[_Row], not_run: Sequence[_Row], proven: Sequence[_Row]
) -> list[tuple[str, int, str]]:
    states = [row.state for row in ran]
    return [
        (name, count, mood)
        for name, count, mood in (
            ("failed", states.count("failed"), "bad"),
            ("could not run", states.count("error"), "bad"),
            ("passed now", states.count("passed"), "good"),
            ("not run", len(not_run), "calm"),
            ("still proven", len(proven), "calm"),
        )
        if count or name in ("passed now", "still proven")
    ]


def _changes(stale: Sequence[_Row]) -> list[tuple[Reason, int]]:
    """Return reasons for stale goldens with the number of goldens, the most frequent first."""
    found: dict[Reason, int] = {}
    for row in stale:
        for reason in dict.fromkeys(row.entry.outcome.reasons):
            found[reason] = found.get(reason, 0) + 1
    return sorted(found.items(), key=lambda item: (-item[1], str(item[0])))[:MAX_CHANGES]


def _flatten(ids: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, str]]:
    """Yield (dotted name, text) of nested tables."""
    for key, value in ids.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{key} / ")
        elif isinstance(value, list | tuple):
            yield f"{prefix}{key}", ", ".join(str(item) for item in value) or "none"
        else:
            yield f"{prefix}{key}", "none" if value is None else str(value)


def _bar_width(used: float, full: float = 100.0) -> str:
    """Return a bar's length: linear, the tolerance at half of ``full``, limited to ``full``."""
    share = used / 2 if used <= 1 else 1 - 0.5 / used
    return f"{full * min(max(share, 0.01), 1.0):.1f}"


_PAGE = Page(
    "report.html.j2",
    number=number,
    quantity=quantity,
    use=use,
    used=tolerance_ratio,
    bar=_bar_width,
)
