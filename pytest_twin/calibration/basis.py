"""Inputs of a calibration record: kinematics up to the flange, plan, observations."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pytest_twin.calibration.plan import Plan
from pytest_twin.realization.record_inputs import basis_json, load_unfitted
from pytest_twin.records.basis import Uses
from pytest_twin.twin import RealizationRef, Twin, load_twin


def calibration_basis(plan: Plan, inputs: Iterable[str], folder: Path) -> dict[str, Any]:
    """Return ``basis`` of ``calibration.json``.

    Args:
        inputs: its input files, relative to the plan's folder.

    Raises:
        TwinError: the robot's model cannot be read.
    """
    files = {name: plan.path.parent / name for name in inputs}
    files = {name: path for name, path in files.items() if path != plan.robot}
    twin, model = None, None
    if plan.robot is not None:
        has_twin = plan.robot.suffix.lower() in (".yaml", ".yml")
        twin = load_twin(plan.robot) if has_twin else Twin(plan.robot, plan.robot.stem, {})
        reference = (
            twin.first_realization if has_twin else RealizationRef(plan.robot.stem, plan.robot)
        )
        model = load_unfitted(twin, reference)
        twin = twin.before_calibration(plan.id) if has_twin else None
    uses = Uses(frames=(plan.flange,), measures_zeros="joint_zeros" in plan.estimate)
    return basis_json(model, uses, twin, folder, files, has_twin=twin is not None)
