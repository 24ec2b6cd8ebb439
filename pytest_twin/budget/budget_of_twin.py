"""Compute the content of ``budget.json``: each category with its displacement of the task frame."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from pytest_twin import __version__
from pytest_twin.budget.calibration_unknowns import claims, read_calibration_unknowns
from pytest_twin.budget.categories import CATEGORIES, Category
from pytest_twin.budget.identification import identified_parameters
from pytest_twin.budget.lines import (
    Line,
    calibration_line,
    identification_line,
    total_of,
)
from pytest_twin.budget.propagate import Spread
from pytest_twin.budget.task import Task, task_of
from pytest_twin.budget.unmodelled_errors import unmodelled_errors, untested_conditions
from pytest_twin.budget.verdict import QUANTITIES, assess
from pytest_twin.errors import TwinError
from pytest_twin.gate.specs import load_golden, spec_paths
from pytest_twin.realization import Realization, load
from pytest_twin.realization.record_inputs import refuse_stale_records, result_basis
from pytest_twin.time_limit import current_limit, limited, skips
from pytest_twin.twin import Twin, load_twin

MEANING = (
    "root mean square displacement of the frame by one standard deviation of the causes, over all "
    "poses; a normal value stays within 1.96 standard deviations 95 % of the time"
)


def budget_of_file(
    path: str,
    progress: Callable[[float], None] | None = None,
    folder: str = "",
    seconds: float = 0.0,
) -> dict[str, Any]:
    """Return the content of ``budget.json`` for a ``twin.yaml``.

    Args:
        path: path of the ``twin.yaml``.
        progress: called with the fraction done.
        folder: folder of the result; that of the twin if empty.
        seconds: limit of the processor time, s; 0 for none.

    Raises:
        TwinError: a twin, a record or a recording cannot be used, or a record is stale.
    """
    twin = load_twin(Path(path))
    refuse_stale_records(twin)
    first = twin.first_realization
    # Shapes are needed only for simulating motion; their files may be missing.
    shapes = bool(twin.budget.recordings)
    realization = load(first.file, twin=twin, name=first.name, shapes=shapes)
    with limited(seconds) as limit:
        document = budget(twin, realization, progress or (lambda done: None))
    document["not_tried"] = limit.not_tried
    if note := limit.note():
        document["notes"].insert(0, note)
    document["basis"] = result_basis(realization, "budget", Path(folder or twin.root))
    return document


def budget(
    twin: Twin, realization: Realization, progress: Callable[[float], None]
) -> dict[str, Any]:
    """Return the error budget of a loaded twin."""
    task = task_of(twin, realization)
    notes = list(task.notes)
    superseded = {name for entry in twin.calibrations for name in entry.supersedes}
    superseded |= {name for fit in twin.fits for name in fit.supersedes}
    lines = _lines(twin, realization, task, superseded, notes, progress)
    limit = current_limit()
    unmodelled = [
        error
        for error in unmodelled_errors(task, lines, twin, superseded)
        # Of a record that was not tried, it is not known what its estimates explain.
        if _work(error["kind"], error["id"]) not in limit.not_tried
    ]
    linear = total_of([line.linear for line in lines if line.linear is not None])
    drawn = total_of([line.drawn for line in lines if line.drawn is not None])
    goldens = _goldens(twin, notes)
    spec = twin.budget
    return {
        "schema": 1,
        "twin": twin.name,
        **assess(
            drawn,
            unmodelled,
            spec,
            is_complete=not limit.not_tried,
            untested=untested_conditions(task, twin, superseded),
        ),
        "output": {
            "frame": task.frame,
            "frame_source": task.frame_source,
            "poses": len(task.readings),
            "poses_source": task.source,
            "meaning": MEANING,
        },
        "tolerance": {"position": spec.position, "rotation": spec.rotation},
        "categories": [_category(one, lines, unmodelled, goldens, twin) for one in CATEGORIES],
        "lines": [{**line.to_json(), "share": _share(line.drawn, twin)} for line in lines],
        "unmodelled": unmodelled,
        "total": {
            "linear": None if linear is None else linear.to_json(),
            "sampled": None if drawn is None else drawn.to_json(),
            "share": _share(drawn, twin),
            "rule": "root of the sum of squares of the lines: each record varies on its own; what "
            "one record estimated together is one line",
        },
        "notes": notes,
        "software": {"pytest-twin": __version__},
    }


def _lines(
    twin: Twin,
    realization: Realization,
    task: Task,
    superseded: Collection[str],
    notes: list[str],
    progress: Callable[[float], None],
) -> list[Line]:
    found: list[Line] = []
    taken: set[str] = set()
    count = max(1, len(twin.calibrations) + len(twin.fits))
    # Newest records come first; quantities that they measured are not taken from earlier ones.
    for done, entry in enumerate(reversed(twin.calibrations), 1):
        if entry.record.id in superseded or skips(_work("calibration", entry.record.id)):
            continue
        cause = read_calibration_unknowns(entry, task, twin.path, taken)
        taken |= claims(entry.record)
        line = calibration_line(cause, task, twin)
        if line is None:
            why = "; ".join(cause.left_out) or "it has no covariance"
            notes.append(f"calibration {entry.record.id!r} moves nothing here: {why}")
        else:
            found.append(line)
        progress(done / count)
    for done, fit in enumerate(twin.fits, 1 + len(twin.calibrations)):
        if fit.record.id not in superseded and not skips(_work("identification", fit.record.id)):
            line = identification_line(
                identified_parameters(fit, task, realization), task, realization
            )
            if line is not None:
                found.append(line)
        progress(done / count)
    return sorted(found, key=lambda one: -(0.0 if one.drawn is None else one.drawn.position))


def _work(kind: str, ident: str) -> str:
    """Name of the work for one record, for the reader."""
    return f"{kind} {ident!r}"


def _share(spread: Spread | None, twin: Twin) -> dict[str, float | None]:
    """Return the displacement as a fraction of the task's tolerance."""
    spec = twin.budget
    return {
        "position": None
        if spread is None or spec.position is None
        else spread.position / spec.position,
        "rotation": None
        if spread is None or spec.rotation is None
        else spread.rotation / spec.rotation,
    }


def _category(
    category: Category,
    lines: Sequence[Line],
    unmodelled: Sequence[Mapping[str, Any]],
    goldens: Mapping[str, Sequence[str]],
    twin: Twin,
) -> dict[str, Any]:
    holding = [
        line for line in lines if any(part["category"] == category.id for part in line.parts)
    ]
    leading = [line for line in holding if line.category == category.id]
    elsewhere = [line for line in holding if line.category != category.id]
    estimates = [
        one
        for line in holding
        for part in line.parts
        if part["category"] == category.id
        for one in part["estimates"]
    ]
    moves = total_of([line.drawn for line in leading if line.drawn is not None])
    # A record that was not tried may measure it.
    unmeasured = "not_tried" if current_limit().not_tried else "not_measured"
    state = "measured" if leading else "counted_elsewhere" if elsewhere else unmeasured
    records = [line.record for line in holding]
    beyond = None
    if category.id == "unmodelled" and unmodelled:
        state = "measured"
        records = [line.record for line in lines if line.id in {one["id"] for one in unmodelled}]
        beyond = {
            quantity: max(
                (entry[quantity]["beyond"] for entry in unmodelled if entry[quantity]), default=None
            )
            for quantity in QUANTITIES
        }
    owner = twin.budget.owners.get(category.id)
    return {
        "category": category.id,
        "state": state,
        "metric": category.metric,
        "estimates": estimates,
        "moves": None if moves is None else moves.to_json(),
        "beyond": beyond,
        "share": _share(moves, twin),
        "lines": [line.id for line in leading],
        "counted_in": [line.id for line in elsewhere],
        "evidence": {
            "records": [dict(record) for record in records],
            "goldens": [one for kind in category.goldens for one in goldens.get(kind, ())],
        },
        "owner": owner,
        "owner_said": "budget: owners: of twin.yaml" if owner else "no owner is declared",
        "next_test": category.next_test,
        "measured_by": category.command,
    }


def _goldens(twin: Twin, notes: list[str]) -> dict[str, list[str]]:
    """Return kind of golden -> ids of the twin's goldens."""
    found: dict[str, list[str]] = {}
    for path in spec_paths(twin):
        try:
            golden = load_golden(path, twin)
        except TwinError as error:
            notes.append(f"not among the evidence: {error}")
            continue
        found.setdefault(golden.kind, []).append(golden.id)
    return found
