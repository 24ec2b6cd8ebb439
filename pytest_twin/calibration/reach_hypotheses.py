"""Hypotheses for errors that grow with the reach of the arm, each with its next test."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pytest_twin.calibration.observability import hold_gauges
from pytest_twin.calibration.problem import CalibrationProblem, arms
from pytest_twin.calibration.residual_errors import Errors, errors_of
from pytest_twin.calibration.solve import Fit, solve

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
        fit: the fit.
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
    return sorted(causes, key=lambda one: -float(one.get("removes", one.get("along_gravity", 1.0))))


def hypotheses_in_words(hypotheses: list[dict[str, Any]]) -> str:
    """Return the hypotheses as one text."""
    parts = []
    for one in hypotheses:
        shown = ""
        if "removes" in one:
            shown = f" (removes {100 * max(one['removes'], 0.0):.0f} % of the squared error)"
        elif "along_gravity" in one:
            shown = f" ({100 * one['along_gravity']:.0f} % of the squared error is along gravity)"
        parts.append(f"{one['cause'].replace('_', ' ')}{shown}: {one['next_test']}")
    return "; ".join(parts)
