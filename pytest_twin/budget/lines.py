"""Lines of an error budget: one for each record, with its effect on the task frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.budget.calibration import CalibrationUnknowns
from pytest_twin.budget.categories import category_of_parameter
from pytest_twin.budget.forced_motion import simulate_displacement
from pytest_twin.budget.identification import (
    IdentifiedParameters,
    displacement_by_shifts,
    gravity_effort,
)
from pytest_twin.budget.propagate import (
    DRAWS,
    Spread,
    first_order,
    linearization_warnings,
    normal_draws,
    root_of,
    sample_displacement,
)
from pytest_twin.budget.task import SIMULATED_S, Task, record_path
from pytest_twin.errors import SimulationError
from pytest_twin.realization import Realization
from pytest_twin.twin import CalibrationEntry, FitEntry, Twin

_CORRELATED = 0.1
"""Correlation above which a pair of parts is reported."""


@dataclass(frozen=True)
class Line:
    """One independent cause and its effect.

    Attributes:
        category: category of the part that moves the frame most.
        record: kind, id, file, digest and date of the record.
        parts: correlated parts, each with category, estimates and its own displacement.
        correlated: pairs of parts of different categories, with their largest correlation.
        linear, drawn: displacement by all parts, to first order and by draws; None if unknown.
        joints: joint -> RMS displacement of its position, rad or m.
        effort: joint -> RMS error of its effort, N*m or N.
        slides: prismatic joints, in m and N.
        method: method of the propagation to the task.
        left_out: unknowns that do not move the frame, with the reason.
    """

    id: str
    category: str
    record: Mapping[str, Any]
    parts: tuple[Mapping[str, Any], ...]
    correlated: tuple[Mapping[str, Any], ...]
    method: str
    linear: Spread | None = None
    drawn: Spread | None = None
    joints: Mapping[str, float] = field(default_factory=dict)
    effort: Mapping[str, float] = field(default_factory=dict)
    slides: frozenset[str] = frozenset()
    warnings: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return fields for JSON, in SI units."""
        return {
            "id": self.id,
            "category": self.category,
            "record": dict(self.record),
            "parts": [dict(part) for part in self.parts],
            "correlated": [dict(pair) for pair in self.correlated],
            "method": self.method,
            "linear": None if self.linear is None else self.linear.to_json(),
            "sampled": None if self.drawn is None else self.drawn.to_json(),
            "joints": {
                joint: {"rms": value, "unit": "m" if joint in self.slides else "rad"}
                for joint, value in self.joints.items()
            },
            "effort": {
                joint: {"rms": value, "unit": "N" if joint in self.slides else "N*m"}
                for joint, value in self.effort.items()
            },
            "warnings": list(self.warnings),
            "left_out": list(self.left_out),
        }


def calibration_line(found: CalibrationUnknowns, task: Task, twin: Twin) -> Line | None:
    """Return the line of a calibration; None if it does not move the frame.

    Raises:
        FormatError: a matrix is no covariance.
    """
    record = found.entry.record
    if not found.names:
        return None
    root = root_of(found.covariance, record.path)
    moving = found.frame(task, np.zeros(len(found.names)))
    linear = first_order(moving, root)
    drawn = sample_displacement(lambda step: found.frame(task, step), normal_draws(root))
    deviations = np.sqrt(np.diag(found.covariance))
    parts = []
    for part in found.parts:
        own = list(part.columns)
        alone = first_order(
            replace(moving, turn=moving.turn[:, :, own], shift=moving.shift[:, :, own]),
            root_of(found.covariance[np.ix_(own, own)], record.path),
        )
        estimates = [
            {"name": name, "value": value, "std": float(deviations[column]), "unit": unit}
            for (name, (value, unit)), column in zip(part.estimate.items(), own, strict=True)
        ]
        parts.append(_part(part.name, part.category, estimates, alone))
    groups = {part.name: (part.category, part.columns) for part in found.parts}
    return Line(
        record.id,
        _leading_category(parts),
        _record("calibration", found.entry, record.path, record.sha256, twin),
        tuple(parts),
        tuple(_correlated_parts(found.covariance, groups)),
        f"J C J^T over {len(task.readings)} poses, and {DRAWS} draws through the whole forward "
        "kinematics",
        linear,
        drawn,
        warnings=tuple(linearization_warnings(linear, drawn)),
        left_out=found.left_out,
    )


def identification_line(
    found: IdentifiedParameters, task: Task, realization: Realization
) -> Line | None:
    """Return the line of an identification; None if it states no parameter."""
    record, twin = found.entry.record, realization.twin
    assert twin is not None
    if not record.covariance_names:
        return None
    warnings: list[str] = []
    linear = drawn = None
    alone: Mapping[str, Spread] = {}
    joints: Mapping[str, float] = {}
    effort: Mapping[str, float] = {}
    method = "stated, not propagated to the task"
    if (found.columns or found.effects) and task.trial is not None:
        try:
            motion = simulate_displacement(found, task, realization)
            linear, drawn = motion.frame, motion.drawn
            joints, alone = motion.joints, motion.alone
            seconds = float(task.trial.time[-1])
            method = (
                f"replays of the first {seconds:.3g} s of {task.trial.name} with the parameters "
                "changed: one by one, and by draws"
            )
        except SimulationError as error:
            warnings.append(f"not simulated: {error}")
    if found.columns and linear is None:
        effort = gravity_effort(found, task)
        method = (
            f"static gravity effort over {len(task.readings)} poses: no motion with commands is "
            f"declared (budget: recordings:, of which {SIMULATED_S:g} s are simulated)"
        )
    shifted = displacement_by_shifts(found, task, realization) if linear is None else None
    if shifted is not None:
        linear, drawn = shifted
        poses = f"{len(task.readings)} poses, and {DRAWS} draws"
        of_shifts = f"delays, encoder zeros, gears and gains by J C J^T over {poses}"
        method = f"{method}; {of_shifts}" if found.columns else of_shifts
    if linear is not None and drawn is not None:
        warnings += linearization_warnings(linear, drawn)
    names = list(record.covariance_names)
    matrix = np.reshape(record.covariance, (len(names), len(names)))
    groups: dict[str, tuple[str, tuple[int, ...]]] = {}
    for at, name in enumerate(names):
        category = category_of_parameter(name)
        own = groups.get(category, (category, ()))[1]
        groups[category] = (category, (*own, at))
    parts = [
        _part(
            category.replace("_", " "),
            category,
            [
                {
                    "name": names[at],
                    "value": record.values.get(names[at]),
                    "std": float(np.sqrt(max(matrix[at, at], 0.0))),
                    "unit": record.units.get(names[at], ""),
                }
                for at in own
            ],
            alone.get(category),
        )
        for category, own in groups.values()
    ]
    return Line(
        record.id,
        _leading_category(parts),
        _record("identification", found.entry, record.path, record.sha256, twin),
        tuple(parts),
        tuple(_correlated_parts(matrix, groups)),
        method,
        linear,
        drawn,
        joints,
        effort,
        frozenset(j for j, kind in realization.structure.joint_type.items() if kind == "slide"),
        tuple(warnings),
        found.left_out,
    )


def total_of(spreads: Sequence[Spread]) -> Spread | None:
    """Combine independent causes: root of the sum of squares."""
    return _combine_spreads(spreads) if spreads else None


def _combine_spreads(spreads: Sequence[Spread]) -> Spread:
    def root(values: Callable[[Spread], float]) -> float:
        return float(np.sqrt(sum(values(one) ** 2 for one in spreads)))

    return Spread(
        root(lambda one: one.position),
        root(lambda one: one.rotation),
        root(lambda one: one.worst_position),
        root(lambda one: one.worst_rotation),
    )


def _part(
    name: str, category: str, estimates: Sequence[Mapping[str, Any]], alone: Spread | None
) -> dict[str, Any]:
    return {
        "name": name,
        "category": category,
        "estimates": list(estimates),
        "alone": None if alone is None else alone.to_json(),
    }


def _leading_category(parts: Sequence[Mapping[str, Any]]) -> str:
    """Category of the part that moves the frame most; if none does, of that with most estimates."""
    return str(max(parts, key=_size)["category"])


def _size(part: Mapping[str, Any]) -> tuple[float, int]:
    alone = part["alone"]
    return (0.0 if alone is None else alone["position"]), len(part["estimates"])


def _correlated_parts(
    covariance: FloatArray, groups: Mapping[str, tuple[str, tuple[int, ...]]]
) -> list[dict[str, Any]]:
    """Pairs of correlated parts, each with the largest correlation of an unknown of each."""
    deviations = np.sqrt(np.diag(covariance).clip(1e-300))
    correlation = np.abs(covariance / np.outer(deviations, deviations))
    names = list(groups)
    found = []
    for i, one in enumerate(names):
        for other in names[:i]:
            largest = float(correlation[np.ix_(groups[one][1], groups[other][1])].max())
            if largest >= _CORRELATED:
                found.append({"pair": [other, one], "correlation": min(largest, 1.0)})
    return sorted(found, key=lambda pair: -pair["correlation"])


def _record(
    kind: str, entry: CalibrationEntry | FitEntry, path: Path, sha256: str, twin: Twin
) -> dict[str, Any]:
    return {
        "kind": kind,
        "id": entry.record.id,
        "file": record_path(path, twin),
        "sha256": sha256,
        "date": entry.date,
    }
