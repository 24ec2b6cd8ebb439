"""Section ``budget:`` of ``twin.yaml``: frame of the task, its tolerance, owners of the errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pytest_twin.formats import typed
from pytest_twin.formats.result_record import ResultRecord
from pytest_twin.record_spec import Unaffected


@dataclass(frozen=True, slots=True)
class BudgetSpec:
    """Task of an error budget.

    Attributes:
        frame: frame whose pose error is budgeted; None for the twin's tool centre point.
        poses: configurations, each joint -> encoder reading, rad or m.
        recordings: recordings of the task's motion.
        position, rotation: allowed pose error, m and rad, or None.
        owners: category of error -> person or team responsible for it.
        record: budget in use, a ``budget.json``; None without.
        unaffected: changed inputs that do not touch this budget.
    """

    frame: str | None = None
    poses: tuple[Mapping[str, float], ...] = ()
    recordings: tuple[Path, ...] = ()
    position: float | None = None
    rotation: float | None = None
    owners: Mapping[str, str] = field(default_factory=dict)
    record: ResultRecord | None = None
    unaffected: tuple[Unaffected, ...] = ()

    @classmethod
    def from_json(
        cls,
        data: Mapping[str, Any],
        recordings: tuple[Path, ...],
        record: ResultRecord | None = None,
    ) -> BudgetSpec:
        """Build the spec from the validated table of ``twin.yaml`` and the resolved recordings."""
        stated = {**data, **data.get("tolerance", {}), "recordings": ()}
        return replace(typed.build(stated, cls), recordings=recordings, record=record)
