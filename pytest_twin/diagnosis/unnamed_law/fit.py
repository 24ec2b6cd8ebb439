"""Free laws at the joints that a diagnosis leaves unexplained.

For each variable a table is fitted to the residual in the linearized motion and cross-validated
over whole recordings. The best variable, or a force and a friction, is fitted and cross-validated
again by simulation. A push at some time or a random torque is rejected: it does not occur at the
same values of a variable in another recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr, stdtrit

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.findings import joint_type, joint_unit
from pytest_twin.diagnosis.first_order.sensitivities import Linearization
from pytest_twin.diagnosis.locate import TimeAndRegime
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.unnamed_law.covariates import Covariate
from pytest_twin.diagnosis.unnamed_law.law import AlternativeVariable, FreeLaw
from pytest_twin.diagnosis.unnamed_law.regression import log_ratio, standard_error
from pytest_twin.diagnosis.unnamed_law.selection import (
    JointResidual,
    TableFit,
    add_second_table,
    rank_tables,
)
from pytest_twin.diagnosis.unnamed_law.settings import FREE_LAWS
from pytest_twin.diagnosis.unnamed_law.shape import Curve
from pytest_twin.diagnosis.unnamed_law.table_fit import SimulatedTables, fit_tables
from pytest_twin.diagnosis.verdict import UNSEEN
from pytest_twin.estimation.hypothesis import Hypothesis, Term


@dataclass(frozen=True, slots=True)
class FreeLaws:
    """Laws at all unexplained joints.

    Attributes:
        laws: the largest residual first.
        hypothesis: the findings and the laws.
        notes: reasons why joints have no law, one line each.
    """

    laws: tuple[FreeLaw, ...]
    hypothesis: Hypothesis
    notes: tuple[str, ...]

    def without(self, law: FreeLaw) -> Hypothesis:
        """The hypothesis without one of the laws."""
        return self.hypothesis.without(law.term)


def fit_free_laws(
    prepared: PreparedProblem,
    hypothesis: Hypothesis,
    unexplained_at: Mapping[str, TimeAndRegime],
    segments: NDArray[np.int64],
) -> FreeLaws:
    """Fit free laws at the joints that are left unexplained.

    Args:
        unexplained_at: joint -> where its residual occurs, the largest residual first.
        segments: indices of the segments that may be used; of each recording all or none.
    """
    problem = prepared.problem
    if problem.simulator.models.contact.world.size:
        return FreeLaws((), hypothesis, (
            "no free law was fitted: the robot meets surfaces, where small forces do not have "
            "small consequences",
        ))  # fmt: skip
    recording = np.array([prepared.segment_trial[s] for s in segments])
    if len(set(recording.tolist())) < FREE_LAWS.fewest_recordings:
        return FreeLaws((), hypothesis, (
            f"no free law was fitted: it takes {FREE_LAWS.fewest_recordings} recordings to tell a "
            "function of the state from a push in time",
        ))  # fmt: skip
    found: list[FreeLaw] = []
    notes = []
    for joint, where in list(unexplained_at.items())[: FREE_LAWS.most_joints]:
        column = problem.joints.index(joint)
        if problem.floor[column] >= UNSEEN or _has_table(problem, column):
            continue
        data = _joint_residual(problem, hypothesis, column, segments, recording)
        result = _fit_at_joint(problem, hypothesis, data)
        if isinstance(result, str):
            notes.append(f"no free law at joint {joint}: {result}")
            continue
        chosen, after, ranking = result
        hypothesis = after.hypothesis
        found += _laws(problem, joint, where, chosen, after, ranking)
    return FreeLaws(tuple(found), hypothesis, tuple(notes))


def _has_table(problem: Problem, joint: int) -> bool:
    """Whether the given model has a table at the joint, because two tables cannot be added."""
    return any(
        not Term(effect, joint).law.candidate and any(v[0, joint] != 0.0 for v in values.values())
        for effect, values in problem.simulator.fixed.items()
    )


def _joint_residual(
    problem: Problem,
    hypothesis: Hypothesis,
    joint: int,
    segments: NDArray[np.int64],
    recording: NDArray[np.int64],
) -> JointResidual:
    """Residual of the findings at a joint, with the linearization around them."""
    linear = Linearization(problem, hypothesis, segments)
    residual = linear.residual(problem.residuals([hypothesis], segments)[0])
    level = float(np.median(linear.base.level[0][..., joint]))
    weights = 1.0 / problem.signal_floor
    of_bins = np.repeat(recording, linear.bins.lengths)
    return JointResidual(linear, joint, residual, weights, of_bins, level)


def _fit_at_joint(
    problem: Problem, hypothesis: Hypothesis, data: JointResidual
) -> tuple[TableFit, SimulatedTables, list[TableFit]] | str:
    """Tables in the linearized motion, the same simulated, and all candidates; or the reason why
    there is no law.
    """
    if not np.isfinite(data.residual).all():
        return "the simulation with the findings diverges in places"
    ranking = rank_tables(data)
    if not ranking:
        return "nothing that a force may depend on varies in the recordings"
    chosen = add_second_table(data, ranking)
    share, clear = _removed_share(chosen.regression.square, chosen.errors)
    if share < FREE_LAWS.removes or not clear:
        return (
            "over no variable does a force from some recordings explain the others: the best, "
            f"{_describe_tables(chosen.tables)}, removes {100 * max(share, 0.0):.0f} % of their "
            f"squared error ({100 * FREE_LAWS.removes:.0f} % required). A push in time or a random "
            "torque looks like this"
        )
    after = fit_tables(problem, hypothesis, chosen, data)
    if after is None:
        return "the simulation diverges with it"
    share, clear = _removed_share(after.before, after.errors)
    if share < FREE_LAWS.removes or not clear:
        return (
            f"simulated, {_describe_tables(chosen.tables)} removes {100 * max(share, 0.0):.0f} % "
            "of the squared error of recordings that it was not fitted to "
            f"({100 * FREE_LAWS.removes:.0f} % required)"
        )
    return chosen, after, ranking


def _removed_share(before: FloatArray, errors: FloatArray) -> tuple[float, bool]:
    """Removed share of the (recordings,) squared errors, and whether it exceeds one standard error
    of cross-validation.
    """
    less = before - errors
    if not np.isfinite(errors).all():
        return 0.0, False
    return float(less.sum() / before.sum()), bool(less.sum() > standard_error(less))


def _describe_tables(tables: Sequence[Covariate]) -> str:
    """Kind and variable of each table, in words."""
    kinds = [f"{'friction' if t.is_friction else 'a force'} over {t.variable.name}" for t in tables]
    return " with ".join(kinds)


def _laws(
    problem: Problem,
    joint: str,
    where: TimeAndRegime,
    chosen: TableFit,
    after: SimulatedTables,
    ranking: Sequence[TableFit],
) -> list[FreeLaw]:
    """The fitted tables of a joint as laws with bands, confidences and alternatives."""
    column = problem.joints.index(joint)
    count = len(chosen.tables)
    half_width = _half_width(after)
    share, _ = _removed_share(after.before, after.errors)
    shares = _posterior_shares(ranking)
    parts = zip(
        chosen.tables, np.split(after.coefficients, count), np.split(half_width, count),
        strict=True,
    )  # fmt: skip
    found = []
    for table, values, half in parts:
        kind = joint_type(problem, column)
        unit = table.variable.unit(kind)
        if "," in unit:
            # Only position commands are a variable.
            unit = joint_unit(problem, column)
        curve = Curve(
            table.variable, table.is_friction,
            (unit, "N" if kind == "slide" else "N*m"), table.knots, values, half,
            table.occupancy, table.valid,
        )  # fmt: skip
        mine = [(c, p) for c, p in shares if c.tables[0].variable == table.variable
                and c.tables[0].effect == table.effect]  # fmt: skip
        others = [(c, p) for c, p in shares if (c, p) not in mine]
        alternatives = tuple(
            AlternativeVariable(c.tables[0].variable.name, c.tables[0].is_friction, p)
            for c, p in others if p > FREE_LAWS.least_listed
        ) if count == 1 else ()  # fmt: skip
        confidence = (
            min(sum(p for _, p in mine), FREE_LAWS.most_confidence)
            if count == 1
            else FREE_LAWS.most_confidence
        )
        found.append(
            FreeLaw(
                joint=joint,
                term=Term(table.effect, column),
                curve=curve,
                removed=share,
                confidence=confidence,
                alternatives=alternatives[:4],
                where=where,
            )
        )
    return found


def _half_width(after: SimulatedTables) -> FloatArray:
    """(p,) half widths of 95 % bands, from the larger of the sandwich variance and the jackknife
    variance over recordings.
    """
    count = len(after.left_out)
    spread = after.left_out - after.left_out.mean(axis=0)
    jackknife = (count - 1) / count * np.sum(spread**2, axis=0)
    variance = np.maximum(np.diag(after.covariance), jackknife)
    half: FloatArray = float(stdtrit(max(count - 1, 1), 0.975)) * np.sqrt(variance)
    return half


def _posterior_shares(ranking: Sequence[TableFit]) -> list[tuple[TableFit, float]]:
    """Single tables with their shares, which sum to 1.

    The weight of a table is the p-value of a paired t-test between its errors on left-out
    recordings and those of the best.
    """
    best = ranking[0]
    weights = [1.0]
    for one in ranking[1:]:
        more = log_ratio(one.errors, best.errors)
        ratio = max(float(more.sum()), 0.0) / max(standard_error(more), 1e-12)
        weights.append(2.0 * float(stdtr(max(len(more) - 1, 1), -ratio)))
    total = float(np.sum(weights))
    return [(c, float(w) / total) for c, w in zip(ranking, weights, strict=True)]
