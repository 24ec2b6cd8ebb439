"""Held-out errors of records that the uncertainty of their estimates does not explain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pytest_twin.budget.lines import Line
from pytest_twin.budget.propagate import first_order
from pytest_twin.budget.task import Task
from pytest_twin.calibration.chain import ChainParameters, forward
from pytest_twin.twin import Twin


def unmodelled_lines(task: Task, lines: Sequence[Line], twin: Twin) -> list[dict[str, Any]]:
    """Return unexplained held-out errors of the records, as position errors of the frame.

    Each is an upper bound, because it includes measurement noise.
    """
    found = []
    explained = {line.id: line.linear.position for line in lines if line.linear is not None}
    for calibration in twin.calibrations:
        record = calibration.record
        if record.id not in {line.id for line in lines}:
            continue
        # The error of all three coordinates is used if the record has it.
        error = record.held_out.get("distance_rms")
        if error is None and "translation_rms" in record.held_out:
            error = float(np.sqrt(3.0)) * record.held_out["translation_rms"]
        if error is not None:
            found.append(
                _unexplained_error(record.id, error, explained.get(record.id), "calibration")
            )
    for fit in twin.fits:
        own = fit.record.position_rms
        if fit.record.id in {line.id for line in lines} and own:
            error = frame_error(task, own)
            if error is not None:
                found.append(_unexplained_error(fit.record.id, error, explained.get(fit.record.id),
                                     "identification"))  # fmt: skip
    return found


def frame_error(task: Task, joints: Mapping[str, float]) -> float | None:
    """RMS displacement (m) of the frame by independent errors of joints."""
    columns = [joints.get(joint, 0.0) for joint in task.chain.joints]
    if not any(columns):
        return None
    count = len(columns)
    every = ChainParameters(count, np.zeros(count), tuple(range(count)))
    return first_order(forward(task.chain, task.readings, every), np.diag(columns)).position


def _unexplained_error(
    ident: str, error: float, explained: float | None, kind: str
) -> dict[str, Any]:
    beyond = float(np.sqrt(max(error**2 - (explained or 0.0) ** 2, 0.0)))
    over = "held-out observations" if kind == "calibration" else "whole held-out recordings"
    return {
        "id": ident,
        "kind": kind,
        "over": over,
        "held_out": error,
        "explained": explained,
        "beyond": beyond,
    }
