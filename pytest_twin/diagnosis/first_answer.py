"""A first answer within seconds, from which the search starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.diagnosis.budget import RESERVED_SHARE, Budget
from pytest_twin.diagnosis.likely_effect import LikelyEffect
from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.quick_diagnosis import QuickDiagnosis, quick_diagnosis
from pytest_twin.errors import TwinError
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.open_loop import replay
from pytest_twin.realization import Realization
from pytest_twin.trial import Trial

FIRST_SECONDS = 10.0
"""Limit of the processor time of a first answer, s."""


def first_answer(
    realization: Realization, trials: Sequence[Trial], patched: PatchedModel | None, seconds: float
) -> QuickDiagnosis | None:
    """A quick diagnosis of the recording with the largest error relative to its motion.

    Args:
        trials: recordings to choose from, without test recordings.
        patched: effects of an earlier diagnosis in addition to the model.
        seconds: limit of the processor time, s.

    Returns:
        The quick diagnosis; None if time runs out or the model cannot be simulated.
    """
    budget = Budget(seconds / (1.0 - RESERVED_SHARE))
    try:
        with budget.searching(), np.errstate(over="ignore", invalid="ignore"):
            return quick_diagnosis(realization, _worst_trial(realization, trials), patched)
    except (OutOfTime, TwinError):
        return None


def hypothesis_of(problem: Problem, effects: Sequence[LikelyEffect]) -> Hypothesis | None:
    """Effects of a quick diagnosis in a problem; None if it lacks one of their joints."""
    hypothesis = EMPTY
    for applied in (applied for effect in effects for applied in effect.fitted):
        if applied.joint is not None and applied.joint not in problem.joints:
            return None
        term = _term(problem, applied.effect, applied.joint)
        theta = [
            applied.values[p.name] / problem.scales.value(p, term.joint) for p in term.parameters
        ]
        hypothesis = hypothesis.with_term(term, np.array(theta))
    return hypothesis.with_theta(np.clip(hypothesis.theta, *hypothesis.bounds))


def _term(problem: Problem, effect: str, joint: str | None) -> Term:
    return Term(effect, -1 if joint is None else problem.joints.index(joint))


def _worst_trial(realization: Realization, trials: Sequence[Trial]) -> Trial:
    """The trial with the largest RMS error relative to the travel of a joint."""
    if len(trials) == 1:
        return trials[0]
    replayed = replay(realization, list(trials))

    def error(k: int) -> float:
        trial, moved = trials[k], np.ptp(trials[k].position, axis=0)
        rms = np.sqrt(np.mean((replayed[k].position - trial.position) ** 2, axis=0))
        worst = float(np.max(rms / np.maximum(moved, 1e-9)))
        return worst if np.isfinite(worst) else -1.0

    return trials[max(range(len(trials)), key=error)]
