"""Penalized likelihood of whole sets of effects that takes model error into account.

It differs from the score of the search in three ways. Residuals at the level of noise count as
equal. Efforts are compared with a tolerance of one time step. Model error does not average out
within a recording.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.common_effects import set_size
from pytest_twin.diagnosis.effort_step_tolerance import residuals_with_step_tolerance
from pytest_twin.diagnosis.finding_settings import FINDINGS
from pytest_twin.diagnosis.first_order.beam_search import parameter_penalty
from pytest_twin.diagnosis.first_order.linearized_fit import linearized_slopes
from pytest_twin.diagnosis.first_order.sensitivities import Linearization
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.estimation.score import (
    NOISE_FLOORS,
    effective_samples,
    log_likelihood,
    tempered_samples,
)


def log_misfit(residual: FloatArray, floor: FloatArray) -> float:
    """Sum over signals of the log of the mean squared residual, which is at least that of noise.

    Args:
        residual: (samples, signals).
        floor: (signals,) noise floor.
    """
    mean_square = np.nan_to_num(np.mean(residual**2, axis=0), nan=np.inf)
    return float(np.log(np.maximum(mean_square, (NOISE_FLOORS * floor) ** 2)).sum())


def set_penalty(
    comparison: ModelComparison, h: Hypothesis, samples: FloatArray, idle: int = 0
) -> float:
    """Penalty of the log-likelihood for the parameters and the effects of a set.

    An effect that is common to all joints counts once.

    Args:
        comparison: model comparison of the problem.
        samples: (signals,) effective samples.
        idle: number of parameters without influence, which are not penalized.
    """
    size = set_size(comparison.problem, h)
    return float(
        parameter_penalty(samples) * (size.free_count - idle)
        + comparison.penalty_per_effect * size.effects
    )


def idle_parameters(
    problem: Problem, linear: Linearization, sets: Sequence[Hypothesis]
) -> list[int]:
    """Number of amplitudes of each set that change the prediction by less than the noise.

    They are not penalized. Each effect keeps at least one penalized amplitude.

    Args:
        linear: linearization by which the change is computed.
    """
    tried, base = list(sets), list[dict[tuple[Term, int], int]]()
    for h in sets:
        base.append({})
        for t in h.terms:
            for k in _estimated_amplitudes(t, h):
                base[-1][t, k] = len(tried)
                theta = h.theta.copy()
                theta[h.slice_of(t).start + k] = float(t.parameters[k].neutral or 0.0)
                tried.append(h.with_theta(theta))
    slopes = linearized_slopes(linear, tried)
    out = []
    for h, slope, neutral in zip(sets, slopes, base, strict=False):
        count = 0
        for t in h.terms:
            own, start = _estimated_amplitudes(t, h), h.slice_of(t).start
            idle = 0
            for k in own:
                # The mean slope over the way: a tilt about an axis across all joints changes
                # gravity in second order only.
                mean = 0.5 * (slope[:, :, start + k] + slopes[neutral[t, k]][:, :, start + k])
                off = abs(float(h.theta[start + k]) - float(t.parameters[k].neutral or 0.0))
                change = off * np.sqrt(np.mean(mean**2, axis=0)) / problem.signal_floor
                idle += bool((change < FINDINGS.idle).all())
            count += min(idle, max(len(own) - 1, 0))
        out.append(count)
    return out


def _estimated_amplitudes(term: Term, h: Hypothesis) -> list[int]:
    """Indices of the estimated amplitudes of a term."""
    theta = h.theta[h.slice_of(term)]
    return [k for k in term.amplitude_indices(theta) if term.is_estimated(theta)[k]]


def recordings_of(problem: Problem, *, fitted: bool) -> int:
    """Number of fitted recordings, or of held-out recordings."""
    which = problem.fit if fitted else problem.held_out
    return len({problem.simulator.segments[s].trial for s in which})


def set_evidence(
    comparison: ModelComparison, models: Sequence[ScoredModel], idle: Sequence[int]
) -> tuple[FloatArray, float]:
    """Penalized log-likelihood of sets on fit and validation recordings.

    Model error reduces the effective samples
    (:func:`~pytest_twin.estimation.score.tempered_samples`).

    Args:
        comparison: model comparison of the problem.
        idle: number of parameters of each set that are not penalized.

    Returns:
        The log-likelihood of each set, and the share of the effective samples that remains.
    """
    problem, sets = comparison.problem, [r.hypothesis for r in models]
    residuals = residuals_with_step_tolerance(
        problem, sets, [r.fitted.residual for r in models], problem.fit
    )
    values, whole, kept = evidence_on(
        comparison, sets, residuals, problem.lengths(problem.fit), fitted=True, idle=idle
    )
    if comparison.has_validation:
        held_residuals = [r.held_residual for r in models]
        residuals = residuals_with_step_tolerance(problem, sets, held_residuals, problem.held_out)
        held = evidence_on(
            comparison, sets, residuals, problem.lengths(problem.held_out), fitted=False
        )
        values, whole, kept = values + held[0], whole + held[1], kept + held[2]
    return values, kept / max(whole, 1e-300)


def evidence_on(
    comparison: ModelComparison,
    sets: Sequence[Hypothesis],
    residuals: Sequence[FloatArray],
    lengths: Sequence[int],
    *,
    fitted: bool,
    idle: Sequence[int] = (),
) -> tuple[FloatArray, float, float]:
    """Log-likelihood of sets on fit or on validation recordings.

    Args:
        comparison: model comparison of the problem.
        residuals: (samples, signals) residual of each set on these recordings.
        lengths: number of samples of each segment.
        fitted: whether these are the fit recordings; the penalty is then subtracted.
        idle: number of parameters of each set that are not penalized; none by default.

    Returns:
        The log-likelihood of each set, the sum of the effective samples, and the sum that remains
        with model error.
    """
    problem, floor = comparison.problem, comparison.problem.signal_floor
    closest = min(residuals, key=lambda r: log_misfit(r, floor))
    effective = effective_samples(np.nan_to_num(closest), lengths)
    samples = tempered_samples(
        effective, np.mean(closest**2, axis=0), floor,
        recordings_of(problem, fitted=fitted), len(problem.joints),
    )  # fmt: skip
    values = np.array([log_likelihood(r, NOISE_FLOORS * floor, samples) for r in residuals])
    if fitted:
        idle = idle or [0] * len(sets)
        values -= [set_penalty(comparison, h, samples, n) for h, n in zip(sets, idle, strict=True)]
    return values, float(effective.sum()), float(samples.sum())
