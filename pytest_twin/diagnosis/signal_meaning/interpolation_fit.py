"""Fits for :mod:`~pytest_twin.diagnosis.signal_meaning.command_interpolation`.

Recordings of a simulation contain the integration error of its time step, which may look like
another interpolation of the commands. For example, 2 ms of semi-implicit Euler under a stiff servo
look like interpolation of commands of 10 ms. So each assumption is also fitted with this error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.diagnosis.build_problem import build_problem
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.prepare import NOISE
from pytest_twin.diagnosis.signal_meaning.command_interpolation import (
    MEAN_DELAY,
    AssumptionResiduals,
    CommandInterpolation,
    cross_validated_residuals,
    decide_interpolation,
    log_rms,
)
from pytest_twin.diagnosis.signal_meaning.joint_fit import (
    DELAY,
    SmoothParameterFit,
    SmoothParameters,
    fit_smooth_parameters,
)
from pytest_twin.diagnosis.signal_meaning.settings import INTERPOLATION
from pytest_twin.diagnosis.signal_meaning.step_times import step_intervals
from pytest_twin.diagnosis.simulation_settings import SUBSTEPS
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.recording_options import COMMAND_BETWEEN, CommandBetween
from pytest_twin.trial import Trial

_MIN_REDUCTION = float(np.log(2.0))
"""Reduction of the logarithm of the RMS residual, summed over joints, from which the step of a
simulation is assumed: a factor of 2 at one joint. A smaller reduction does not matter here."""


@dataclass(frozen=True, slots=True)
class InterpolationFit:
    """An answer and the fit under this assumption.

    Attributes:
        answer: interpolation of the commands between their stamps.
        fit: the fit under the answer, or under the assumption that is used if it is open.
        space: the parameters of the fit.
    """

    answer: CommandInterpolation
    fit: SmoothParameterFit
    space: SmoothParameters
    joints: tuple[str, ...]


def fit_interpolation(
    setup: ModelSetup,
    trials: Sequence[Trial],
    interpolations: Sequence[CommandBetween] = COMMAND_BETWEEN,
) -> InterpolationFit:
    """Determine the interpolation of commands between their stamps.

    Args:
        setup: the model with its simulation settings.
        trials: recordings with the same command period.

    Raises:
        TwinError: as :func:`~pytest_twin.diagnosis.build_problem.build_problem`.
    """
    chosen = _fastest_recordings(trials)
    trials_by_interpolation = tuple(
        replace(t, command_between=between, effort=None)
        for between in interpolations
        for t in chosen
    )
    prepared, kept = build_problem(setup, TrialSet(trials_by_interpolation, (), ()), [])
    problem, noise = prepared.problem, prepared.floor_parts[NOISE]
    of = [(t.command_between, t.path, t.offset) for t in kept.fit]
    common = [
        (t.path, t.offset) for t in chosen
        if all((b, t.path, t.offset) in of for b in interpolations)
    ]  # fmt: skip
    groups, owner = [], list[int]()
    for between in interpolations:
        mine = [
            (common.index(of[t][1:]), s)
            for s, t in enumerate(prepared.segment_trial)
            if of[t][0] == between and of[t][1:] in common
        ]
        groups.append(np.array([s for _, s in mine], dtype=np.int64))
        owner = [r for r, _ in mine]
    period = float(np.median([np.median(np.diff(t.command_times)) for t in chosen]))
    space = SmoothParameters(problem, groups, noise)
    fits = fit_smooth_parameters(space, [period * MEAN_DELAY[b] for b in interpolations])
    lengths = problem.lengths(groups[0])
    left = {
        between: _cross_validated_residual(
            _with_best_time_step(fit, space, group), space, lengths, owner
        )
        for between, fit, group in zip(interpolations, fits, groups, strict=True)
    }
    answer = decide_interpolation(left, lengths, owner, noise, period)
    at = interpolations.index(answer.assumed)
    return InterpolationFit(answer, fits[at], space, problem.joints)


def _fastest_recordings(trials: Sequence[Trial]) -> list[Trial]:
    """The beginnings of the recordings whose commands change fastest on average.

    Recordings whose commands step are used only if there is no other: when within its period a
    setpoint that moves on stepped is unknown, and the error of a step outweighs all smooth motion.
    """
    trials = [t for t in trials if not len(step_intervals(t.command))] or trials

    def moved(trial: Trial) -> float:
        return float(np.abs(np.diff(trial.command, axis=0)).sum() / max(trial.duration, 1e-3))

    most = sorted(range(len(trials)), key=lambda i: moved(trials[i]), reverse=True)[
        : INTERPOLATION.most_recordings
    ]
    return [_until_after_first_change(trials[i]) for i in sorted(most)]


def _until_after_first_change(trial: Trial) -> Trial:
    """The beginning of a recording until some seconds after its first change of command."""
    changes = np.flatnonzero(np.diff(trial.command, axis=0).any(axis=1))
    first = float(trial.command_time[changes[0]]) if len(changes) else 0.0
    return replace(
        trial.until(max(first - INTERPOLATION.seconds_before, 0.0) + INTERPOLATION.seconds),
        effort=None,
    )


def _with_best_time_step(
    fit: SmoothParameterFit, space: SmoothParameters, group: NDArray[np.int64]
) -> SmoothParameterFit:
    """The better fit: that for a robot, or that for a simulation with one of several time steps.

    For a simulation the integration error is not corrected; the fit is adapted to first order.
    """
    discretization_error = space.problem.discretization_error
    if (
        any(int(s) not in discretization_error for s in group)
        or not np.isfinite(fit.residual).all()
    ):
        return fit
    error = np.concatenate([discretization_error[int(s)].position for s in group])
    best, least = fit, log_rms(fit.residual, space.noise) - _MIN_REDUCTION
    for substeps in SUBSTEPS:
        residual = fit.residual + error / substeps
        step = space.step(fit.theta, residual, fit.slopes)
        residual = residual - np.einsum("npj,pj->nj", fit.slopes, step)
        left = log_rms(residual, space.noise)
        if left < least:
            nominal, theta = fit.nominal + error / substeps, fit.theta + step
            best = replace(fit, residual=residual, nominal=nominal, theta=theta)
            least = left
    return best


def _cross_validated_residual(
    fit: SmoothParameterFit, space: SmoothParameters, lengths: Sequence[int], owner: Sequence[int]
) -> AssumptionResiduals:
    """Cross-validated residual of a fit.

    Args:
        fit, space: the fit and its parameters.
        lengths, owner: number of samples and recording of each segment.
    """
    ends = np.cumsum([0, *lengths])
    rows = {
        r: np.concatenate([
            np.arange(ends[i], ends[i + 1]) for i, o in enumerate(owner) if o == r
        ])
        for r in dict.fromkeys(owner)
    }  # fmt: skip
    residual = fit.residual
    if len(rows) > 1 and np.isfinite(residual).all():
        steps = {}
        for r, mine in rows.items():
            others = np.delete(np.arange(len(residual)), mine)
            steps[r] = space.step(fit.theta, residual[others], fit.slopes[others])
        residual = cross_validated_residuals(residual, steps, fit.slopes, rows)
    nominal = np.sqrt(np.mean(fit.nominal**2, axis=0))
    return AssumptionResiduals(residual, nominal, fit.has_converged, fit.theta[DELAY])
