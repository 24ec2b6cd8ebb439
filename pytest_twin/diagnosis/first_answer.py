"""A first answer within seconds, and its place in the result of a search that ended early."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.diagnosis.budget import RESERVED_SHARE, Budget
from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.likely_effect import LikelyEffect
from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.quick_diagnosis import QuickDiagnosis, quick_diagnosis
from pytest_twin.diagnosis.run import Run, ScoredHypothesis
from pytest_twin.diagnosis.search.model_comparison import RANKING_ITERATIONS, ModelComparison
from pytest_twin.diagnosis.search.scored_model import SelectedModel
from pytest_twin.diagnosis.search_result import SearchResult, conclude
from pytest_twin.diagnosis.structure_search.refit import fit_by_simulation
from pytest_twin.diagnosis.structure_search.score import Scorer, SimulatedModel
from pytest_twin.diagnosis.structure_search.settings import SETTINGS
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


def keep_first_answer(result: SearchResult, run: Run) -> SearchResult:
    """The better one of a search that ended early and the first answer.

    The effects of the first answer replace those of the search if they pass the acceptance test of
    the search against them. The fit and validation recordings decide.

    Args:
        run: the running diagnosis, with its first answer.
    """
    if not (run.skipped_searches and run.first_answer):
        return result
    problem = result.prepared.problem
    scorer = Scorer(problem, len(candidates(problem)), SETTINGS.earns, SETTINGS.share)
    with run.budget.reserved():
        best = incumbent = scorer.simulate_with_own_correction(result.explanation.hypothesis)
        effects: list[LikelyEffect] = []
        for effect in run.first_answer:
            hypothesis = hypothesis_of(problem, [*effects, effect])
            model = None if hypothesis is None else _refit(scorer, hypothesis, run)
            if model is not None and scorer.is_better(model, best):
                best = model
                effects.append(effect)
        if best is incumbent:
            return result
        comparison = ModelComparison(problem, run)
        selected = SelectedModel(
            comparison.score_without_fit(best.hypothesis, slopes=True),
            comparison.nominal,
            candidate_count=comparison.candidate_count,
            not_simulated=frozenset(best.hypothesis.terms),
        )
        for effect in effects:
            _set_confidence(selected, problem, effect)
        kept = conclude(result.prepared, result.trials, run, selected)
        final = scorer.simulate_with_own_correction(kept.explanation.hypothesis)
    if not scorer.is_better(final, incumbent):
        return result
    run.step(
        problem,
        "first answer",
        "accepted",
        "the search ended early with a model that explains less",
        ScoredHypothesis(final.hypothesis, scorer.gain(final, scorer.nominal)),
        ScoredHypothesis(incumbent.hypothesis, scorer.gain(incumbent, scorer.nominal)),
    )
    return kept


def _refit(scorer: Scorer, start: Hypothesis, run: Run) -> SimulatedModel:
    """A hypothesis fitted to the fit recordings; unchanged if no time is left for that."""
    model = scorer.simulate_with_own_correction(start)
    try:
        with run.budget.fitting():
            fitted, _ = fit_by_simulation(scorer, model, RANKING_ITERATIONS)
    except OutOfTime:
        return model
    return fitted if scorer.is_better(fitted, model) else model


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


def _set_confidence(selected: SelectedModel, problem: Problem, effect: LikelyEffect) -> None:
    """Give the terms of an effect the confidence and the alternatives of the quick diagnosis."""
    alternatives = [
        (_term(problem, name, joints[0] if joints else None), posterior_share)
        for (name, joints), posterior_share in zip(
            effect.alternatives, effect.alternative_shares, strict=True
        )
        if len(joints) <= 1 and set(joints) <= set(problem.joints)
    ]
    for applied in effect.fitted:
        term = _term(problem, applied.effect, applied.joint)
        selected.confidence[term] = effect.posterior_share
        selected.alternatives[term] = alternatives


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
