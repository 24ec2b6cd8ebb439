"""Interpolation of commands between stamps, decided again after the search for effects.

Before the search, ``held`` and ``interpolated`` may be indistinguishable: half a period less delay
looks like feed-forward or a shorter lag. After it, the interpolation that needs fewer effects for
the same recordings is more likely.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.effect_selection import EffectSelection
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search.model_comparison import DECIDING_ITERATIONS, ModelComparison
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search_result import SearchResult, build_problem, conclude
from pytest_twin.diagnosis.signal_meaning.settings import INTERPOLATION
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.recording_options import CommandBetween
from pytest_twin.trial import Trial


def interpolation_with_fewer_effects(
    found: SearchResult, setup: ModelSetup, possible: Sequence[CommandBetween], run: Run
) -> tuple[SearchResult, CommandBetween] | None:
    """The result under another interpolation, if it explains as much with fewer effects; else None.

    Args:
        found: the result under the present interpolation.
        setup: the model with its simulation settings.
        possible: interpolations that the recordings do not rule out.
    """
    start = found.explanation.hypothesis
    if not start.terms:
        return None
    used = {t.command_between for t in found.trials.fit if t.between_source == "assumed"}
    best: tuple[SearchResult, CommandBetween] | None = None
    for between in possible:
        if used == {between}:
            continue
        prepared, trials = build_problem(
            setup, with_interpolation(found.trials, between), [], window=found.prepared.window
        )
        run.begin(f"commands {between} between their stamps", prepared.problem)
        selection = EffectSelection(prepared.problem, run)
        least = _fit_without_one(found, selection.comparison)
        if least is None:
            continue
        selected = selection.simplify(selection.comparison.fit_to_convergence(least))
        other = conclude(prepared, trials, run, selected)
        if _has_fewer_effects(other, found if best is None else best[0]):
            best = other, between
    return best


def _fit_without_one(found: SearchResult, comparison: ModelComparison) -> ScoredModel | None:
    """The best fit with one effect fewer whose error is not larger in any signal; else None."""
    start = found.explanation.hypothesis
    fewer = [start.without(t) for t in start.terms]
    models = comparison.fit_models(fewer, comparison.nominal, DECIDING_ITERATIONS)
    before, floor = found.pruned.fitted.residual, comparison.problem.signal_floor
    as_good = [r for r in models if explains_as_much(r.fitted.residual, before, floor)]
    comparison.score_models(as_good, comparison.nominal)
    return max(as_good, key=lambda r: r.evidence, default=None)


def explains_as_much(residual: FloatArray, before: FloatArray, floor: FloatArray) -> bool:
    """Whether a residual is not larger than another one in any signal.

    Signals are positions and efforts: some effects change efforts alone.

    Args:
        residual, before: (samples, signals).
        floor: (signals,) noise floor, below which residuals are equal.
    """
    return bool((_rms(residual) <= np.maximum(INTERPOLATION.as_well * _rms(before), floor)).all())


def _rms(residual: FloatArray) -> FloatArray:
    """(signals,) RMS of a (samples, signals) residual."""
    rms: FloatArray = np.sqrt(np.mean(residual**2, axis=0))
    return rms


def with_interpolation(trials: TrialSet, between: CommandBetween) -> TrialSet:
    """The trials with an interpolation of commands, unless it is declared."""

    def changed(trial: Trial) -> Trial:
        if trial.between_source != "assumed":
            return trial
        return replace(trial, command_between=between, between_source="data")

    fit, held_out = (tuple(map(changed, role)) for role in (trials.fit, trials.held_out))
    return replace(trials, fit=fit, held_out=held_out)


def _has_fewer_effects(other: SearchResult, found: SearchResult) -> bool:
    """Whether a result has fewer effects and no larger error in any signal."""
    if other.explanation.hypothesis.more_terms(found.explanation.hypothesis) >= 0:
        return False
    if other.errors.keys() != found.errors.keys():
        return False
    now, before = (r.pruned.fitted.residual for r in (other, found))
    if not explains_as_much(now, before, found.prepared.problem.signal_floor):
        return False
    return all(
        e.after <= max(INTERPOLATION.as_well * found.errors[joint].after, e.floor)
        for joint, e in other.errors.items()
    )
