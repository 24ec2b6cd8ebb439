"""Pruning: effects of the chosen model that the recordings do not support are rejected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.noise_levels import in_noise_floors, label, levels_on
from pytest_twin.diagnosis.search.pruning_rules import (
    CLOSEST_KNOWN,
    RULES,
    RefitComparison,
    residual_remains,
)
from pytest_twin.diagnosis.search.pruning_settings import SETTINGS
from pytest_twin.diagnosis.search.scored_model import ScoredModel, SelectedModel
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel, fit
from pytest_twin.estimation.score import laplace_log_likelihood


@dataclass(slots=True)
class PrunedModel:
    """A fitted model after pruning.

    Attributes:
        reduced_models: the model refitted without each remaining effect.
        notes: a line for each rejected effect.
        removal_evidence: term -> log-likelihood ratio of the model without it over the model, where
            effects were judged by that alone.
        closest: rejected effects that were only the closest known ones to what acts at their joint.
    """

    fitted: FittedModel
    reduced_models: list[Hypothesis]
    notes: list[str]
    removal_evidence: Mapping[Term, float] = field(default_factory=dict)
    closest: tuple[Term, ...] = ()


def prune(problem: Problem, selected: SelectedModel, *, single_step: bool = False) -> PrunedModel:
    """Reject effects that do not exceed the noise, and effects that explain too little.

    An effect stays if the refit without it leaves a residual above the noise floor on some tested
    recording. It is rejected too if most of the mismatch of its joint remains: another effect, not
    in the catalogue, is at work there. Effects are removed until no simulation diverges.

    Args:
        single_step: whether each refit takes one step only.
    """
    notes, closest = list[str](), list[Term]()
    # The remaining share is judged once, with all effects: each removal raises it for the others.
    remaining_share_checked = False
    fitted = selected.best.fitted
    likeliest_alternative = {
        t: _likeliest_alternative(selected, t) for t in fitted.hypothesis.terms
    }
    (before,) = levels_on(problem.at(EMPTY), [EMPTY], problem.tested_segments)
    while fitted.hypothesis.terms:
        here = problem.at(fitted.hypothesis)
        refitted, weights, base, levels = refit_without_each(here, fitted, single_step)
        tested = RefitComparison(
            here, fitted, selected.confidence, before, base, refitted, levels, weights,
            likeliest_alternative, selected.not_simulated,
        )  # fmt: skip
        rule, removed = next(((r, removed) for r in RULES if (removed := r(tested))), (None, {}))
        if not removed and not remaining_share_checked:
            remaining_share_checked = True
            rule, removed = residual_remains, residual_remains(tested)
        if not removed:
            reduced_models = [f.hypothesis for f in refitted]
            return PrunedModel(fitted, reduced_models, notes, closest=tuple(closest))
        notes += removed.values()
        closest += [tested.terms[k] for k in removed] if rule in CLOSEST_KNOWN else []
        fitted = _with_slopes(here, tested.without(list(removed)), weights)
    return PrunedModel(fitted, [], notes, closest=tuple(closest))


def _likeliest_alternative(selected: SelectedModel, term: Term) -> float:
    """Confidence of the likeliest alternative to an effect; no effect at all is one too."""
    others = [a.confidence for a in selected.alternatives_to(term)]
    nothing = 1.0 - selected.confidence.get(term, 1.0) - sum(others)
    return max([nothing, *others])


def prune_by_likelihood(comparison: ModelComparison, best: ScoredModel) -> PrunedModel:
    """Keep the effects of another search that raise the likelihood of whole recordings.

    The likelihood is that of absolute deviations, as in fits of stick-slip motion.
    """
    notes: list[str] = []
    while best.hypothesis.terms:
        terms = best.hypothesis.terms
        best = replace(best, problem=comparison.problem.at(best.hypothesis))
        starts = [best.hypothesis.without(t) for t in terms]
        reduced_models = comparison.fit_models(starts, best, SETTINGS.refit_iterations)
        comparison.score_models(reduced_models, best, likelihood=laplace_log_likelihood)
        least = max(range(len(terms)), key=lambda k: reduced_models[k].evidence)
        if reduced_models[least].evidence < 0.0:
            removal_evidence = {t: r.evidence for t, r in zip(terms, reduced_models, strict=True)}
            return PrunedModel(
                best.fitted, [r.hypothesis for r in reduced_models], notes, removal_evidence
            )
        notes.append(
            f"rejected: {label(comparison.problem, terms[least])}: it reduces the error over whole "
            "recordings too little"
        )
        (best,) = comparison.fit_models([reduced_models[least].hypothesis], best, 0, slopes=True)
    return PrunedModel(best.fitted, [], notes)


def refit_without_each(
    problem: Problem, fitted: FittedModel, single_step: bool = False
) -> tuple[list[FittedModel], FloatArray, FloatArray, list[FloatArray]]:
    """Refit a model without each of its effects.

    Each refit starts with the Jacobian of the model. In a hurry it takes one step only.

    Returns:
        The refits; their (signals,) weights; (signals,) residual of the model on the tested
        recordings, in noise floors; and that of each refit.
    """
    weights = 1.0 / (problem.signal_floor * np.hypot(_finite_levels(fitted, problem), 1.0))
    starts = [fitted.hypothesis.without(t) for t in fitted.hypothesis.terms]
    shared = [
        fitted.jacobian[:, :, fitted.hypothesis.parameters_without(t)]
        for t in fitted.hypothesis.terms
    ]
    refitted = fit(
        problem, starts, weights, problem.fit,
        iterations=1 if single_step else SETTINGS.refit_iterations,
        slopes=False, jacobians=shared,
    )  # fmt: skip
    each = [fitted.hypothesis, *(f.hypothesis for f in refitted)]
    base, *levels = levels_on(problem, each, problem.tested_segments)
    return refitted, weights, base, levels


def _with_slopes(problem: Problem, fitted: FittedModel, weights: FloatArray) -> FittedModel:
    """The same fit with its Jacobian."""
    if fitted.jacobian.shape[2] == fitted.hypothesis.theta.size:
        return fitted
    return fit(problem, [fitted.hypothesis], weights, problem.fit, iterations=0)[0]


def _finite_levels(fitted: FittedModel, problem: Problem) -> FloatArray:
    level = in_noise_floors(fitted.residual, problem.signal_floor)
    return np.where(np.isfinite(level), level, 0.0)
