"""Errors of the test recordings over the longest windows that the model with the findings follows.

The search predicts motions that are not repeatable in short windows. In a short window nearly every
residual is small: that the residual is at the noise floor is shown by long ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from pytest_twin.diagnosis.build_problem import build_problem, residuals_everywhere
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.search_result import SearchResult, joint_errors
from pytest_twin.diagnosis.verdict import JointError
from pytest_twin.diagnosis.window_length import model_follows_recordings, window_of_errors
from pytest_twin.errors import TwinError
from pytest_twin.estimation.hypothesis import EMPTY


@dataclass(frozen=True, slots=True)
class LongWindows:
    """Errors in windows that are longer than those of the search.

    Attributes:
        seconds: duration of the windows, s.
        errors: joint -> errors.
    """

    seconds: float
    errors: Mapping[str, JointError]


def errors_over_longest_windows(tested: SearchResult, setup: ModelSetup) -> LongWindows | None:
    """Errors over whole recordings, halves, quarters: the first that the model follows.

    None if whole recordings are tested already, or if the model follows no longer windows.

    Args:
        tested: the findings on the test recordings.
        setup: the model with its simulation settings.
    """
    short = window_of_errors(tested.prepared.problem)
    if short is None:
        return None
    setup = replace(setup, cold_fractions=tested.prepared.cold_fractions)
    findings = tested.explanation.hypothesis
    recordings = tested.trials.held_out or tested.trials.fit
    seconds = max(t.duration for t in recordings)
    while seconds >= 2.0 * short:
        try:
            prepared, _ = build_problem(
                setup, tested.trials, [], window=seconds, scales=tested.prepared.problem.scales
            )
        except TwinError:
            seconds /= 2.0
            continue
        problem = prepared.problem
        after = residuals_everywhere(problem, findings)
        if model_follows_recordings(problem, after):
            prepared = prepared.with_lower_floor(findings) or prepared
            before = residuals_everywhere(problem, EMPTY)
            return LongWindows(seconds, joint_errors(prepared, before, after))
        seconds /= 2.0
    return None
