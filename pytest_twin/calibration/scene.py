"""Data for the figure of a calibration: the chain in one pose, and errors over the workspace."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.parameters import State
from pytest_twin.calibration.problem import CalibrationProblem, describe_pose, predicted_poses
from pytest_twin.calibration.residual_errors import Errors
from pytest_twin.metrics.pose import rigid

MOST_ARROWS = 400
"""Largest number of errors in the figure."""


def scene(
    problem: CalibrationProblem,
    state: State,
    errors: Mapping[str, tuple[CalibrationProblem, Errors]],
) -> dict[str, Any]:
    """Return the chain, frames and error arrows in the base, m.

    Args:
        problem: problem with its unknowns.
        errors: ``held_out`` and ``fitted`` -> problem on these observations, and their errors.
    """
    flange = predicted_poses(problem, state)
    there = np.flatnonzero(np.isfinite(flange).all(axis=(1, 2)))
    middle = flange[there, :3, 3].mean(axis=0)
    # The figure shows the pose nearest to the middle of the workspace.
    row = int(there[np.argmin(np.linalg.norm(flange[there, :3, 3] - middle, axis=1))])
    return {
        "observation": problem.observations.ids[row],
        "chain": _chain(problem, state, row) if problem.chain is not None else [],
        "frames": _frames(problem, state, flange[row]),
        "arrows": [
            arrow
            for kind, (part, found) in errors.items()
            for arrow in _arrows(kind, part, state, found)
        ],
    }


def _chain(problem: CalibrationProblem, state: State, row: int) -> list[dict[str, Any]]:
    """Return name and position of the base, each joint and the flange."""
    chain = problem.chain
    assert chain is not None
    values = chain.signs * problem.readings[row] + chain.offsets + state.zeros
    pose = np.eye(4)
    found = [{"name": chain.base, "xyz": [0.0, 0.0, 0.0]}]
    for at, name in enumerate(chain.joints):
        pose = pose @ chain.placements[at]
        found.append({"name": name, "xyz": pose[:3, 3].tolist()})
        moved = chain.axes[at] * values[at]
        turn = Rotation.from_rotvec(moved * chain.revolute[at]).as_matrix()
        pose = pose @ rigid(turn, moved * (not chain.revolute[at]))
    found.append({"name": chain.frame, "xyz": (pose @ chain.end)[:3, 3].tolist()})
    return found


def _frames(problem: CalibrationProblem, state: State, flange: FloatArray) -> list[dict[str, Any]]:
    found = [frame("base", np.eye(4)), frame(problem.plan.flange, flange)]
    for name, pose in state.poses.items():
        words = describe_pose(name, problem.plan.mount).removeprefix("the ").partition(" ")[0]
        if name.endswith(".mounted"):
            found.append(frame(words, flange @ pose, on_flange=True))
        else:
            found.append(frame(words, pose))
    return found


def frame(name: str, pose: FloatArray, *, on_flange: bool = False) -> dict[str, Any]:
    """Return name, position (m) and axes of a (4, 4) pose in the base, and ``on_flange``."""
    return {
        "name": name,
        "xyz": pose[:3, 3].tolist(),
        "axes": pose[:3, :3].T.tolist(),
        "on_flange": on_flange,
    }


def _arrows(
    kind: str, problem: CalibrationProblem, state: State, errors: Errors
) -> list[dict[str, Any]]:
    """Return flange positions and prediction errors in the base's axes, m."""
    flange = predicted_poses(problem, state)
    step = max(1, -(-len(errors.ids) // MOST_ARROWS))
    return [
        {"id": name, "kind": kind, "at": flange[row, :3, 3].tolist(), "error": error.tolist()}
        for name, row, error in list(zip(errors.ids, errors.rows, errors.in_base, strict=True))[
            ::step
        ]
    ]
