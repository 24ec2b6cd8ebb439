"""Effects that are refused: impossible totals, and shape parameters that are not identifiable."""

from __future__ import annotations

from pytest_twin.diagnosis.physical_totals import impossible_effects
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.recorded_range import RecordedRange, unidentifiable_effects
from pytest_twin.estimation.hypothesis import Hypothesis, Term


def refused_effects(
    problem: Problem, hypothesis: Hypothesis, recorded: RecordedRange | None = None
) -> dict[Term, str]:
    """Effects of a hypothesis that are refused, and the reason of each.

    Args:
        hypothesis: effects with parameters.
        recorded: ranges of the recordings; computed from the problem by default.
    """
    return {
        **unidentifiable_effects(problem, hypothesis, recorded),
        **impossible_effects(problem, hypothesis),
    }
