"""Errors of the test recordings over the longest windows that the model with the findings follows.

The search predicts motions that are not repeatable in short windows. In a short window nearly every
residual is small: that the residual is at the noise floor is shown by long ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.build_problem import build_problem, residuals_everywhere
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.prepare import PreparedProblem
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


@dataclass(frozen=True, slots=True)
class FollowedWindows:
    """The longest windows that a model follows.

    Attributes:
        seconds: their duration, s.
        prepared: their problem.
        trials: the recordings that are used.
        residual: (samples, signals) of the model in all of them.
    """

    seconds: float
    prepared: PreparedProblem
    trials: TrialSet
    residual: FloatArray


def followed_windows(
    hypothesis: Hypothesis, cut: PreparedProblem, setup: ModelSetup, trials: TrialSet
) -> FollowedWindows | None:
    """Whole recordings, halves, quarters: the longest windows that a model follows.

    None if a problem has whole recordings already, or the model follows no windows that are at
    least twice as long as its own.

    Args:
        hypothesis: effects of the model, in the scales of ``cut``, which the windows keep.
        cut: the problem with short windows.
        trials: its recordings.
    """
    short = window_of_errors(cut.problem)
    if short is None:
        return None
    setup, scales = replace(setup, cold_fractions=cut.cold_fractions), cut.problem.scales
    seconds = max(t.duration for t in trials.held_out or trials.fit)
    while seconds >= 2.0 * short:
        try:
            prepared, kept = build_problem(setup, trials, [], window=seconds, scales=scales)
        except TwinError:
            seconds /= 2.0
            continue
        residual = residuals_everywhere(prepared.problem, hypothesis)
        if model_follows_recordings(prepared.problem, residual):
            return FollowedWindows(seconds, prepared, kept, residual)
        seconds /= 2.0
    return None


def errors_over_longest_windows(tested: SearchResult, setup: ModelSetup) -> LongWindows | None:
    """Errors over the longest windows that the model follows; None if none are longer.

    Args:
        tested: the findings on the test recordings.
        setup: the model with its simulation settings.
    """
    findings = tested.explanation.hypothesis
    followed = followed_windows(findings, tested.prepared, setup, tested.trials)
    if followed is None:
        return None
    prepared = followed.prepared.with_lower_floor(findings) or followed.prepared
    before = residuals_everywhere(prepared.problem, EMPTY)
    return LongWindows(followed.seconds, joint_errors(prepared, before, followed.residual))
