"""What ``twin.yaml`` says of the error budget: the task's output, tolerance, and owners."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class BudgetSpec:
    """What an error budget is about.

    Attributes:
        frame: whose pose the task needs; None for the twin's tool centre point.
        poses: joint -> what its encoder reads there, rad or m.
        recordings: the task's motion.
        position, rotation: what the task allows, m and rad, or None.
        owners: category -> who answers for it.
    """

    frame: str | None = None
    poses: tuple[Mapping[str, float], ...] = ()
    recordings: tuple[Path, ...] = ()
    position: float | None = None
    rotation: float | None = None
    owners: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def from_json(cls, data: Mapping[str, Any], recordings: tuple[Path, ...]) -> BudgetSpec:
        """From the validated table of ``twin.yaml``, its recordings resolved."""
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
