"""Errors of the test recordings over the longest windows that the model with the findings follows.

The search predicts motions that are not repeatable in short windows. In a short window nearly every
residual is small: that the residual is at the noise floor is shown by long ones.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, replace

from pytest_twin.diagnosis.build_problem import build_problem, residuals_everywhere
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search_result import SearchResult, joint_errors
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict import JointError
from pytest_twin.diagnosis.window_length import model_follows_recordings, window_of_errors
from pytest_twin.errors import TwinError
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis


@dataclass(frozen=True, slots=True)
class LongWindows:
    """Errors in windows that are longer than those of the search.

    Attributes:
        seconds: duration of the windows, s.
        errors: joint -> errors.
    """

    seconds: float
    errors: Mapping[str, JointError]


def followed_windows(
    hypothesis: Hypothesis, problem: Problem, setup: ModelSetup, trials: TrialSet
) -> tuple[float, PreparedProblem, TrialSet] | None:
    """Whole recordings, halves, quarters: the longest windows that a model follows.

    None if a problem has whole recordings already, or the model follows no windows that are at
    least twice as long as its own.

    Args:
        hypothesis: effects of the model, in the scales of ``problem``.
        trials: recordings; only those to be predicted are followed, if there are any.

    Returns:
        Duration of the windows, s, their problem with the same scales, and the used recordings.
    """
    short = window_of_errors(problem)
    if short is None:
        return None
    seconds = max(t.duration for t in trials.held_out or trials.fit)
    while seconds >= 2.0 * short:
        with contextlib.suppress(TwinError):
            prepared, kept = build_problem(setup, trials, [], window=seconds, scales=problem.scales)
            if model_follows_recordings(
                prepared.problem, residuals_everywhere(prepared.problem, hypothesis)
            ):
                return seconds, prepared, kept
        seconds /= 2.0
    return None


def errors_over_longest_windows(tested: SearchResult, setup: ModelSetup) -> LongWindows | None:
    """Errors over the longest windows that the model follows; None if none are longer.

    Args:
        tested: the findings on the test recordings.
        setup: the model with its simulation settings.
    """
    setup = replace(setup, cold_fractions=tested.prepared.cold_fractions)
    findings = tested.explanation.hypothesis
    followed = followed_windows(findings, tested.prepared.problem, setup, tested.trials)
    if followed is None:
        return None
    seconds, prepared, _ = followed
    prepared = prepared.with_lower_floor(findings) or prepared
    before, after = (residuals_everywhere(prepared.problem, h) for h in (EMPTY, findings))
    return LongWindows(seconds, joint_errors(prepared, before, after))
