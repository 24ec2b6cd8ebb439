"""Held-out errors of records that the uncertainty of their estimates does not explain."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from pytest_twin.budget.lines import Line
from pytest_twin.budget.propagate import Spread, first_order
from pytest_twin.budget.task import Task
from pytest_twin.calibration.chain import ChainParameters, forward
from pytest_twin.records.basis import Basis
from pytest_twin.twin import Twin


def unmodelled_errors(
    task: Task, lines: Sequence[Line], twin: Twin, superseded: Collection[str]
) -> list[dict[str, Any]]:
    """Return unexplained held-out errors of the records, as errors of the frame.

    Each is an upper bound, because it includes measurement noise. A record without covariance
    explains nothing of its error.

    Args:
        task: frame and poses.
        twin: twin with the records.
        superseded: ids of records that are not used.
    """
    explained = {line.id: line.linear for line in lines}
    errors = []
    for calibration in twin.calibrations:
        record = calibration.record
        # The error of all three coordinates is used if the record has it.
        position = record.held_out.get("distance_rms")
        if position is None and "translation_rms" in record.held_out:
            position = float(np.sqrt(3.0)) * record.held_out["translation_rms"]
        rotation = record.held_out.get("angle_rms")
        if rotation is None and "rotation_rms" in record.held_out:
            rotation = float(np.sqrt(3.0)) * record.held_out["rotation_rms"]
        errors.append((record.id, "calibration", "held-out observations", position, rotation))
    for fit in twin.fits:
        spread = frame_error(task, fit.record.position_rms)
        errors.append(
            (
                fit.record.id, "identification", "whole held-out recordings",
                None if spread is None else spread.position,
                None if spread is None else spread.rotation,
            )
        )  # fmt: skip
    return [
        {
            "id": ident,
            "kind": kind,
            "over": over,
            "position": _unexplained_error(position, explained.get(ident), "position"),
            "rotation": _unexplained_error(rotation, explained.get(ident), "rotation"),
        }
        for ident, kind, over, position, rotation in errors
        if ident not in superseded and (position is not None or rotation is not None)
    ]


def untested_conditions(task: Task, twin: Twin, superseded: Collection[str]) -> str:
    """Payloads and controllers of the task under which no record of the drives was made.

    Returns:
        A sentence; empty if the task's recordings state none, or a record covers each.
    """
    bases = [
        Basis.from_json(fit.record.basis, fit.record.path).uses
        for fit in twin.fits
        if fit.record.id not in superseded and fit.record.basis is not None
    ]
    if not bases:
        return ""
    untested = [
        f"{kind} {name!r}"
        for kind, of_task, of_records in (
            ("payload", task.payloads, {name for uses in bases for name in uses.payloads}),
            ("controller", task.controllers, {name for uses in bases for name in uses.controllers}),
        )
        for name in sorted(of_task - of_records)
    ]
    if not untested:
        return ""
    return (
        f"the task's recordings have {' and '.join(untested)}, under which no record was made or "
        "tested, so the errors there are not known"
    )


def frame_error(task: Task, joints: Mapping[str, float]) -> Spread | None:
    """Displacement of the frame by independent RMS errors of joints (rad or m)."""
    columns = [joints.get(joint, 0.0) for joint in task.chain.joints]
    if not any(columns):
        return None
    count = len(columns)
    every = ChainParameters(count, np.zeros(count), tuple(range(count)))
    return first_order(forward(task.chain, task.readings, every), np.diag(columns))


def _unexplained_error(
    error: float | None, explained: Spread | None, quantity: str
) -> dict[str, float | None] | None:
    if error is None:
        return None
    known = None if explained is None else float(getattr(explained, quantity))
    return {
        "held_out": error,
        "explained": known,
        "beyond": float(np.sqrt(max(error**2 - (known or 0.0) ** 2, 0.0))),
    }
