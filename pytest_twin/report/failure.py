"""Text on a failed golden: the measure that exceeded its tolerance, the time, and the excess."""

from __future__ import annotations

from collections.abc import Sequence

from pytest_twin.outcome import Measure, Outcome, Reason, tolerance_ratio
from pytest_twin.report.text import number, printable, quantity, use

MAX_ROWS = 40
"""Largest number of measures in the table of a failed golden."""
MAX_REASONS = 8
"""Largest number of changes that are listed as reasons."""

_AFTER_AUDIT = (
    "correct the file, or accept each finding by name in twin.yaml, under accepted_findings:, with "
    "a reason and an owner"
)


def headline(outcome: Outcome) -> str:
    """Return a line with the golden and its worst measure or error."""
    return printable(f"{outcome.key}: {what(outcome)}")


def what(outcome: Outcome) -> str:
    """Return a line with the golden's worst measure or error, without its name."""
    worst = outcome.worst
    if outcome.status == "error" or worst is None:
        return printable(outcome.error or "nothing was measured")
    if worst.against == "audit":
        return printable(worst.subject)
    if outcome.status == "passed":
        return printable(f"{worst.name} of {worst.subject} used {use(worst)} of its tolerance")
    failed = [measure for measure in outcome.measures if not measure.passed]
    others = f" ({len(failed) - 1} more failed)" if len(failed) > 1 else ""
    return printable(f"{_excess_sentence(worst)}{others}")


def failure_text(
    outcome: Outcome, *, location: str, plot: str | None = None, advice: str = ""
) -> str:
    """Return the report of a failed golden for a terminal.

    Args:
        outcome: a golden that did not pass.
        location: the spec's file and line, ``golden/fk/home.yaml:12``.
        advice: text after the quick diagnosis, such as the command for the full one.
    """
    lines = [headline(outcome)]
    if outcome.diagnosis is not None:
        lines.append(printable(f"  diagnosis (quick): {outcome.diagnosis}{advice}"))
    worst = outcome.worst
    rows: list[tuple[str, str]] = []
    audited = worst is not None and worst.against == "audit"
    if audited:
        failed = [measure.subject for measure in outcome.measures if not measure.passed]
        rows += [("" if i else "critical", text) for i, text in enumerate(failed[1:])]
        rows.append(("next", _AFTER_AUDIT))
    elif outcome.status != "error" and worst is not None:
        when = f" {worst.when}" if worst.when else ""
        rows += [
            ("worst", f"{worst.name} of {worst.subject}{when}"),
            ("measured", quantity(worst.measured, worst.unit)),
            (worst.against, quantity(worst.golden, worst.unit)),
            ("error", quantity(worst.error, worst.unit)),
            ("tolerance", quantity(worst.tolerance, worst.unit)),
            ("margin", f"{quantity(worst.margin, worst.unit)} (used {use(worst)})"),
        ]
    rows += [("" if i else "ran because", text) for i, text in enumerate(_reasons(outcome.reasons))]
    rows.append(("spec", location))
    if plot is not None:
        rows.append(("plot", plot))
    width = max(len(name) for name, _ in rows)
    lines += [f"  {name:<{width}}  {printable(text)}".rstrip() for name, text in rows]
    if len(outcome.measures) > 1 and not audited:
        lines += ["", *measure_table(outcome.measures)]
    return "\n".join(lines)


def measure_table(measures: Sequence[Measure]) -> list[str]:
    """Return a table of measures, the worst first."""
    ordered = sorted(measures, key=tolerance_ratio, reverse=True)
    timed = any(measure.time is not None for measure in ordered[:MAX_ROWS])
    head = (
        "",
        "measure",
        "of",
        *(["at"] if timed else []),
        "measured",
        "against",
        "error",
        "tolerance",
        "margin",
    )
    rows = [
        (
            "ok" if measure.passed else "FAIL",
            measure.name,
            measure.subject,
            *([measure.when.removeprefix("at ")] if timed else []),
            quantity(measure.measured, measure.unit),
            f"{quantity(measure.golden, measure.unit)} ({measure.against})",
            number(measure.error),
            number(measure.tolerance),
            number(measure.margin),
        )
        for measure in ordered[:MAX_ROWS]
    ]
    table = [head, *(tuple(printable(cell) for cell in row) for row in rows)]
    widths = [max(len(row[i]) for row in table) for i in range(len(head))]
    lines = [
        "  " + "  ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)).rstrip()
        for row in table
    ]
    left_out = ordered[MAX_ROWS:]
    if left_out:
        failed = sum(not measure.passed for measure in left_out)
        lines.append(f"  and {len(left_out)} more, {failed} of them failed")
    return lines


def _excess_sentence(worst: Measure) -> str:
    when = f" {worst.when}" if worst.when else ""
    if worst.margin != worst.margin:  # NaN
        return f"{worst.name} of {worst.subject} is not a number{when}"
    return (
        f"{worst.name} of {worst.subject} exceeded its tolerance of "
        f"{quantity(worst.tolerance, worst.unit)} by {quantity(-worst.margin, worst.unit)}{when}"
    )


def _reasons(reasons: Sequence[Reason]) -> list[str]:
    shown = [str(reason) for reason in reasons[:MAX_REASONS]]
    if len(reasons) > MAX_REASONS:
        shown.append(f"and {len(reasons) - MAX_REASONS} more changes")
    return shown
