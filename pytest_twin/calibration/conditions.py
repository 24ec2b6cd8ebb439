"""Conditions that no residual shows, and under which a record holds."""

from __future__ import annotations

from typing import Any

from pytest_twin.calibration.problem import CalibrationProblem
from pytest_twin.calibration.terms import PivotTerm

FLANGE_POSES = (
    "flange.* are poses of the flange, not of a tool that is set in the controller, and the "
    "controller's joint zeros and links are right; to test it, give robot: with columns joint.NAME "
    "and estimate joint_zeros"
)
HAND_POSES = FLANGE_POSES.replace("flange.*", "poses of the hand's stream").replace(
    "give robot: with columns joint.NAME", "give observations: with robot: and columns joint.NAME"
)
ONE_DELAY = (
    "no filter delays one stream more than the other: its delay is a part of the offset; to test "
    "it, record the streams unfiltered"
)
_JOINT_ZEROS = (
    "the robot's joint zeros and links are right; to test it, add joint_zeros to estimate"
)
_STIFF_TOOL = (
    "the tool does not bend by more than the residuals show: one that bends looks like one of "
    "another length; to test it, pivot again with another force at the tip"
)


def add_conditions(document: dict[str, Any], conditions: list[str]) -> None:
    """Add the conditions to each record of ``calibration.json``."""
    if conditions:
        for record in document["records"].values():
            record["holds_if"] = conditions


def conditions_of(problem: CalibrationProblem) -> list[str]:
    """Return what the records of a problem assume.

    Constant errors of the flange's poses are the same as another base and camera, so that no poses
    show them. A weight bends a tool by its sine of the tilt, as a longer tool moves the tip.
    """
    found = []
    if problem.chain is None:
        found.append(FLANGE_POSES)
    elif not problem.layout.zeros:
        found.append(_JOINT_ZEROS)
    if any(isinstance(term, PivotTerm) for term in problem.terms):
        found.append(_STIFF_TOOL)
    return found
