"""Section ``budget:`` of ``twin.yaml``: frame of the task, its tolerance, owners of the errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class BudgetSpec:
    """Task of an error budget.

    Attributes:
        frame: frame whose pose error is budgeted; None for the twin's tool centre point.
        poses: configurations, each joint -> encoder reading, rad or m.
        recordings: recordings of the task's motion.
        position, rotation: allowed pose error, m and rad, or None.
        owners: category of error -> person or team responsible for it.
    """

    frame: str | None = None
    poses: tuple[Mapping[str, float], ...] = ()
    recordings: tuple[Path, ...] = ()
    position: float | None = None
    rotation: float | None = None
    owners: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def from_json(cls, data: Mapping[str, Any], recordings: tuple[Path, ...]) -> BudgetSpec:
        """Build the spec from the validated table of ``twin.yaml`` and the resolved recordings."""
        tolerance = {name: float(value) for name, value in data.get("tolerance", {}).items()}
        return cls(
            frame=data.get("frame"),
            poses=tuple(
                {joint: float(value) for joint, value in pose.items()}
                for pose in data.get("poses", ())
            ),
            recordings=recordings,
            position=tolerance.get("position"),
            rotation=tolerance.get("rotation"),
            owners=dict(data.get("owners", {})),
        )
