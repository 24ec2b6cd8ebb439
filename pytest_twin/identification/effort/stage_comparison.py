"""Compare each stage with the nominal values, and compute the error of each joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.estimation.paired_test import compare_paired
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.essential_parameters import SIGNIFICANT, EssentialParameters
from pytest_twin.identification.effort.groups import EXCLUDES
from pytest_twin.identification.effort.least_squares import (
    LinearProblem,
    Solution,
    deviations,
    dry_levels,
    solve,
)
from pytest_twin.identification.regressor import BaseParameters
from pytest_twin.identification.stages import HeldOut, Stage, StageName, judge_stage, shares

_LINEAR_STAGES: tuple[StageName, ...] = ("gravity", "inertia", "friction", "drive")
_ENOUGH_MOVING = 10
"""Fewest samples of a moving joint for excluding its rows at rest from the comparison."""


@dataclass(frozen=True)
class EffortError:
    """Error of one joint's effort, predicted from its measured motion.

    Attributes:
        relative: |measured - predicted| / |measured|.
        rms: root mean square error, N*m or N (A if the effort is a current).
        moving: ``relative`` over samples at which the joint moves; None if it never moves.
    """

    relative: float
    rms: float
    moving: float | None


def compare_stages(
    problem: LinearProblem,
    tested: LinearProblem,
    fitted: EssentialParameters,
    stage_of: Sequence[StageName],
    prior: FloatArray,
    base: BaseParameters,
    held_out: bool,
) -> tuple[Stage, ...]:
    """Compare each stage with free parameters and with parameters at nominal values.

    Before a stage, its parameters have nominal values and all other parameters are fitted; after
    it, its parameters are fitted too. Thus parameters of later stages cannot take over the effect
    of the stage, and its values are those of the joint fit. A stage is rejected if the error rises
    by more than the standard error of the difference, sample by sample; if none of its parameters
    is significant, it is not observable.
    """
    found: list[Stage] = []
    own = np.array(stage_of)
    dry = dry_levels(problem, fitted.values)
    after = _weighted_errors(tested, fitted.values, fitted.solution, dry)
    for name in _LINEAR_STAGES:
        mine = fitted.kept[own[fitted.kept] == name]
        words = tuple(parameter_name(base, int(i)) for i in mine)
        if not len(mine):
            exists = bool((own == name).any())
            why = (
                "the motion does not distinguish any of its parameters from zero"
                if exists
                else "the robot has no such parameter that its efforts show"
            )
            found.append(Stage(name, "not_observable", why, (), None, EXCLUDES[name]))
            continue
        others = np.setdiff1d(fitted.kept, mine)
        before = np.zeros(len(own))
        held = np.flatnonzero(own == name)
        before[held] = prior[held]
        rest = LinearProblem(
            problem.matrix[..., others],
            np.where(problem.known, problem.effort - problem.matrix @ before, 0.0),
            problem.known, problem.resting, problem.dry[:, others], problem.lengths,
        )  # fmt: skip
        before[others] = solve(rest, intervals=False).values
        without = _weighted_errors(tested, before, fitted.solution, dry)
        count = max(int(np.isfinite(after).sum()), 1)
        one = HeldOut(
            float(np.sqrt(np.nansum(without**2) / count)),
            float(np.sqrt(np.nansum(after**2) / count)),
            "standard deviations of the fit",
        )
        paired = compare_paired(np.nan_to_num(without), np.nan_to_num(after), tested.lengths)
        share = paired.standard_error / max(float(np.mean(np.nansum(without**2, axis=1))), 1e-300)
        chance = float(np.sqrt(1.0 + share)) - 1.0
        why = "" if held_out else "nothing is held out, the error is that of what was fitted"
        stage = judge_stage(Stage(name, "accepted", why, words, None, EXCLUDES[name]), one, chance)
        at = np.isin(fitted.kept, mine)
        values, half = fitted.solution.values[at], fitted.solution.half_width[at]
        if stage.state == "rejected" and (Z95 * np.abs(values) < SIGNIFICANT * half).all():
            why = f"none of its parameters differs from zero by {SIGNIFICANT:g} standard deviations"
            stage = replace(stage, state="not_observable", why=f"{why}, and {stage.why}")
        found.append(stage)
    return tuple(found)


def with_data(
    stages: Sequence[Stage],
    problem: LinearProblem,
    fitted: EssentialParameters,
    stage_of: Sequence[StageName],
    recordings: Sequence[str],
) -> tuple[Stage, ...]:
    """Return the stages with the share of each recording in the information on their parameters.

    Args:
        stages: stages of the linear problem.
        problem: rows of the fitted recordings.
        fitted: fit of the essential parameters.
        stage_of: (b,) stage of each parameter.
        recordings: names of the recordings, in the order of the rows.
    """
    own = np.array(stage_of)[fitted.kept]
    columns = problem.matrix[..., fitted.kept] * fitted.solution.weight[..., None]
    each = np.split(np.sum(columns**2, axis=1), np.cumsum(problem.lengths)[:-1])
    information = np.array([rows.sum(axis=0) for rows in each])
    return tuple(
        replace(stage, data=shares(recordings, information[:, own == stage.name]))
        for stage in stages
    )


def parameter_name(base: BaseParameters, at: int) -> str:
    """Return ``JOINT.KIND`` if a base parameter is one parameter, else its expression."""
    alone = np.count_nonzero(base.combination[at]) == 1
    return base.names[at] if alone else base.expressions[at]


def _weighted_errors(
    problem: LinearProblem, values: FloatArray, fitted: Solution, dry: FloatArray
) -> FloatArray:
    """(n, joints) residuals, divided by the fit's noise of each joint; NaN where not compared.

    Rows at rest of a moving joint are excluded. There, dry friction of unknown sign hides the
    effect of the stage, and a long rest is only one observation.
    """
    deviation = deviations(problem.resting, fitted.noise, dry)
    known = problem.known & np.isfinite(deviation)
    moving = known & ~problem.resting
    known = np.where(moving.sum(axis=0) >= _ENOUGH_MOVING, moving, known)
    off = problem.effort - problem.matrix @ values
    return np.where(known, off / np.where(known, deviation, 1.0), np.nan)


def errors_of(
    problem: LinearProblem, values: FloatArray, joints: Sequence[str]
) -> dict[str, EffortError]:
    """Return joint -> error with (b,) parameters, without joints of unknown effort."""
    off = problem.effort - problem.matrix @ values
    found = {}
    for k, joint in enumerate(joints):
        rows = problem.known[:, k]
        if not rows.any():
            continue
        moving = rows & ~problem.resting[:, k]
        found[joint] = EffortError(
            relative=_ratio(off[rows, k], problem.effort[rows, k]),
            rms=float(np.sqrt(np.mean(off[rows, k] ** 2))),
            moving=_ratio(off[moving, k], problem.effort[moving, k]) if moving.any() else None,
        )
    return found


def _ratio(off: FloatArray, measured: FloatArray) -> float:
    size = float(np.linalg.norm(measured))
    return float(np.linalg.norm(off)) / size if size > 0 else 0.0
