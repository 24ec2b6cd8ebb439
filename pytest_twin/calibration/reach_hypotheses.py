"""Hypotheses for errors that grow with the reach of the arm, each with its next test."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pytest_twin.calibration.observability import hold_gauges
from pytest_twin.calibration.problem import CalibrationProblem, arms
from pytest_twin.calibration.residual_errors import Errors, errors_of
from pytest_twin.calibration.solve import Fit, solve

CLEAR, APART = 0.5, 0.2
"""Part of the squared error that the most likely cause explains, and by how much more than the
others. Link geometry under its prior takes up to 0.44 of the error of a compliant arm."""

_TESTS = {
    "joint_zeros": "add joint_zeros to estimate",
    "geometry": "add geometry to estimate",
    "compliance": "repeat poses with another payload (column payload)",
}


def reach_hypotheses(fit: Fit, held: CalibrationProblem, errors: Errors) -> list[dict[str, Any]]:
    """Return the possible causes, the one that removes most of the held-out error first.

    Joint zeros and link geometry are fitted. Compliance bends an arm along gravity; its share is
    the part of the squared error along the z axis of the base.

    Args:
        held: the problem on the held-out observations.
        errors: held-out errors of the fit.
    """
    before = float(np.mean(errors.translation**2))
    causes = []
    for wider in arms(fit.problem):
        free, _ = hold_gauges(wider, fit.state)
        name = "geometry" if free.layout.links else "joint_zeros"
        if name in fit.problem.plan.estimate:
            continue
        start = replace(fit.state, links=np.zeros(len(free.layout.links)))
        other = solve(free, start)
        after = errors_of(replace(held, layout=other.problem.layout), other.state)
        after = after.only(np.isin(after.ids, errors.ids))
        share = 1.0 - float(np.mean(after.translation**2)) / before
        causes.append({"cause": name, "removes": share, "next_test": _TESTS[name]})
    along = float(np.sum(errors.in_base[:, 2] ** 2) / np.sum(errors.in_base**2))
    causes.append(
        {"cause": "compliance", "along_gravity": along, "next_test": _TESTS["compliance"]}
    )
    if fit.problem.chain is None:
        # Flange poses do not say which joint is wrong.
        causes.insert(
            0,
            {
                "cause": "joint_zeros or geometry",
                "next_test": "give robot: and columns joint.NAME, and add joint_zeros to estimate",
            },
        )
    by_size = {one["cause"]: _explained(one) for one in causes}
    if {"joint_zeros", "geometry"} <= set(by_size):
        gained = by_size["geometry"] - by_size["joint_zeros"]
        if gained < APART:
            by_size["geometry"] = min(by_size["geometry"], by_size["joint_zeros"] - 1e-9)
    return sorted(causes, key=lambda one: -by_size[one["cause"]])


def hypotheses_in_words(hypotheses: list[dict[str, Any]]) -> str:
    """Return the hypotheses as one text, which says whether one of them is the most likely."""
    parts = []
    for one in hypotheses:
        figure = ""
        if "removes" in one:
            figure = f" (removes {100 * max(one['removes'], 0.0):.0f} % of the squared error)"
        elif "along_gravity" in one:
            figure = f" ({100 * one['along_gravity']:.0f} % of the squared error is along gravity)"
        parts.append(f"{one['cause'].replace('_', ' ')}{figure}: {one['next_test']}")
    start = "most likely " if _is_clear(hypotheses) else "these data do not tell which one: "
    return start + "; ".join(parts)


def _is_clear(hypotheses: list[dict[str, Any]]) -> bool:
    """Whether the first hypothesis explains most of the error, and far more than the others."""
    best, *others = hypotheses
    if best["cause"] == "joint_zeros":
        # Links are fitted with the zeros, so they explain nearly as much whatever the cause is.
        others = [one for one in others if one["cause"] != "geometry"]
    size = _explained(best)
    return size >= CLEAR and all(size - _explained(one) >= APART for one in others)


def _explained(hypothesis: dict[str, Any]) -> float:
    """Part of the squared error that a hypothesis explains; 1 for one that is not tested."""
    return float(hypothesis.get("removes", hypothesis.get("along_gravity", 1.0)))
