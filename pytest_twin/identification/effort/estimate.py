"""Choose the estimator: least squares, or instrumental variables if least squares is biased."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.blocks import Bootstrap, bootstrap
from pytest_twin.identification.effort.essential_parameters import (
    EssentialParameters,
    find_essential_parameters,
    omission,
)
from pytest_twin.identification.effort.instruments import (
    Endogeneity,
    endogeneity,
    solve_instrumental,
    with_commanded_motion,
)
from pytest_twin.identification.effort.least_squares import (
    LinearProblem,
    Solution,
    is_determined,
    solve,
)

Estimator = Literal["weighted least squares", "instrumental variables"]
SQUARES: Estimator = "weighted least squares"
INSTRUMENTS: Estimator = "instrumental variables"


@dataclass(frozen=True)
class EffortEstimate:
    """Essential parameters with the chosen estimator and the reason.

    Attributes:
        why: reason for the choice, in one sentence.
        squares: weighted least squares of the same parameters.
        test: test for noise in the regressor; None without an instrument.
    """

    fitted: EssentialParameters
    estimator: Estimator
    why: str
    squares: Solution
    test: Endogeneity | None
    bootstrap: Bootstrap

    def to_json(self) -> dict[str, Any]:
        """Return the entry ``estimator`` of ``identification.json``."""
        found: dict[str, Any] = {"name": self.estimator, "why": self.why}
        if self.test is not None:
            found["endogeneity"] = self.test.to_json()
        return found


def estimate(
    problem: LinearProblem, tested: LinearProblem, found: EssentialParameters
) -> EffortEstimate:
    """Choose the estimator by the test of Durbin, Wu and Hausman, and check its intervals.

    Args:
        problem: columns that the motion excites, on the fitted recordings.
        tested: the same columns on the held-out recordings.
        found: least-squares fit of the essential parameters.
    """
    own, test = problem.only(found.kept), None
    squares, kept = found.solution, found.kept
    solution, estimator = squares, SQUARES
    if own.instrument is None:
        why = "no instrument: not every joint has position commands"
    elif not is_determined(own.instrument, own).all():
        why = "no instrument: the commanded motion does not move every parameter"
    else:
        instruments = solve_instrumental(own, squares)
        test = endogeneity(own, tested.only(kept), squares, instruments)
        why = test.words
        if test.is_biased:
            estimator = INSTRUMENTS
            # The commanded motion is used, because noise in the measured motion would bias least
            # squares.
            found = find_essential_parameters(with_commanded_motion(problem))
            kept, own = found.kept, problem.only(found.kept)
            squares = solve(own)
            solution = solve_instrumental(own, squares)
            bias = omission(with_commanded_motion(problem), kept, found.held, solution)
            half = np.hypot(solution.half_width, Z95 * bias)
            solution = replace(solution, half_width=half)
    left = own.instrument if estimator == INSTRUMENTS else None
    return EffortEstimate(
        fitted=replace(found, solution=solution),
        estimator=estimator,
        why=why,
        squares=squares,
        test=test,
        bootstrap=bootstrap(own, solution, left),
    )  # fmt: skip
