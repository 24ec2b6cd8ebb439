"""Effects that no finding may contain: impossible totals, and shapes that no recording shows."""

from __future__ import annotations

from pytest_twin.diagnosis.hypothesis import Hypothesis, Term
from pytest_twin.diagnosis.physical_totals import impossible
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.recorded_range import RecordedRange, not_shown


def refused(
    problem: Problem, hypothesis: Hypothesis, recorded: RecordedRange | None = None
) -> dict[Term, str]:
    """Effects of a hypothesis that no finding may contain, and why.

    Args:
        problem: what to explain.
        hypothesis: effects with parameters.
        recorded: range of the recordings, where it is known.
    """
    return {**not_shown(problem, hypothesis, recorded), **impossible(problem, hypothesis)}
