"""Describe plans and updates in lines for the terminal.

This module reads no files.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pytest_twin.gate.plan import Plan
from pytest_twin.gate.update import Update
from pytest_twin.report.text import quantity

MAX_CHANGES = 60
"""Largest number of changed values that are printed."""


def why_lines(plan: Plan) -> list[str]:
    """State for each golden whether it is fresh or stale, and which parts have changed."""
    lines = list(plan.notes)
    for task in plan.tasks.values():
        if not task.is_stale:
            proven = f"release {task.proof.release:04d}" if task.proof else ""
            lines.append(f"fresh  {task.key}  proven in {proven}")
            continue
        lines.append(f"stale  {task.key}")
        lines += [f"         {reason}" for reason in task.reasons]
    lines += plan.stale_records
    lines += _unchecked_records(plan)
    lines += [f"missing  {ident}" for ident in plan.missing]
    lines += [f"dropped  {key}  (retired, or its realization was removed)" for key in plan.dropped]
    lines += [f"orphaned trace  {name}" for name in plan.orphans]
    lines += plan.chain_changes
    lines += list(plan.problems)
    lines.append(f"{len(plan.stale)} stale, {len(plan.fresh)} fresh")
    return lines


def _unchecked_records(plan: Plan) -> Iterator[str]:
    """Calibration records that no golden checks."""
    checked = {
        f"record:{task.golden.target['record']}"
        for task in plan.tasks.values()
        if task.golden.kind == "calibration"
    }
    for ident, record in sorted(plan.parts.items()):
        if (
            ident.startswith("record:")
            and not record.content["superseded"]
            and ident not in checked
        ):
            yield f"unchecked  {ident}  no golden of kind calibration re-checks it"


def update_lines(updates: Sequence[Update]) -> list[str]:
    """List the recorded goldens with old and new values."""
    lines: list[str] = []
    for update in updates:
        lines += _update(update)
    written = sum(bool(update.written) for update in updates)
    lines.append(f"{written} recorded, {len(updates) - written} unchanged")
    return lines


def _update(update: Update) -> Iterator[str]:
    if not update.written:
        yield f"{update.golden}: unchanged"
        return
    word = "recorded for the first time" if update.first else "recorded afresh"
    yield f"{update.golden}: {word} ({', '.join(update.written)})"
    for measure in update.moved:
        yield (
            f"  {measure.name} of {measure.subject}: {quantity(measure.golden, measure.unit)} -> "
            f"{quantity(measure.measured, measure.unit)}"
            f" (tolerance {quantity(measure.tolerance, measure.unit)})"
        )
    changes = () if update.first else update.changes
    for change in changes[:MAX_CHANGES]:
        yield f"  {change.field}: {change.old or '-'} -> {change.new or '-'}"
    if len(changes) > MAX_CHANGES:
        yield f"  and {len(changes) - MAX_CHANGES} more values"
    for measure in update.measures:
        if not measure.passed and measure.against == "audit":
            yield f"  but {measure.subject}"
        elif not measure.passed:
            yield (
                f"  but {measure.name} of {measure.subject} exceeds its tolerance of "
                f"{quantity(measure.tolerance, measure.unit)} against {measure.against}"
            )
