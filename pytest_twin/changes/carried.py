"""Uncertainty of the earlier model, carried into the changes that were estimated beside it.

The changes were fitted with the earlier effects fixed. A small shift of these moves the best fit of
the changes, to first order by the solution of their normal equations; so the covariance of the
earlier parameters adds to that of the changes (Gauss' law of error propagation).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.findings import Explanation
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.estimation.least_squares import finite_differences

_RANK = 1e-6
"""Share of the largest singular value of the changes' slopes below which one counts as zero."""


def carried_half_widths(
    changes: Problem, hypothesis: Hypothesis, earlier: Problem, known: Explanation
) -> Mapping[Term, Mapping[str, float]]:
    """Term -> parameter -> half width of the 95 % interval by the earlier effects alone, SI units.

    Args:
        changes, hypothesis: problem of the changes, and all of them.
        earlier, known: problem of the earlier recordings, and its findings with their covariance.
    """
    uncertainty = known.uncertainty
    if uncertainty is None or not hypothesis.terms:
        return {}
    problem, before = changes.at(hypothesis), known.hypothesis
    shifts, columns, sizes = list[Hypothesis](), list[int](), list[float]()
    for term in before.terms:
        name = earlier.joints[term.joint] if term.joint >= 0 else None
        if name is not None and name not in changes.joints:
            continue
        own = Term(term.effect, -1 if name is None else changes.joints.index(name))
        start = before.slice_of(term).start
        for k, p in enumerate(term.parameters):
            if p.neutral is None or p.choice:
                continue
            step = max(abs(before.theta[start + k]), 1.0) * p.step
            shifts.append(_shifted(hypothesis, own, k, step))
            columns.append(start + k)
            # How much the earlier parameter would have to change, in multiples of its scale.
            scale = earlier.scales.value(p, term.joint)
            present = float(before.theta[start + k]) * scale
            change = step * changes.scales.value(p, own.joint)
            sizes.append(float(p.combined(present, p.neutral + change) - present) / scale)
    rows, steps = finite_differences(hypothesis)
    base, *moved = problem.residuals([hypothesis, *rows, *shifts], problem.fit)
    weight = problem.weights(np.mean(base**2, axis=0))
    slopes = [
        # Motion that diverges has no slope.
        np.nan_to_num((base - r) * weight / s, posinf=0.0, neginf=0.0).ravel()
        for r, s in zip(moved, [*steps, *sizes], strict=True)
    ]
    own_slopes, earlier_slopes = (
        np.array(each).reshape(-1, base.size) for each in (slopes[: len(rows)], slopes[len(rows) :])
    )
    # Zero for a parameter whose slope is rounding, such as the damping of a servo without it.
    gain = np.linalg.lstsq(own_slopes.T, earlier_slopes.T, rcond=_RANK)[0]
    covariance = _within_bounds(
        uncertainty.covariance[np.ix_(columns, columns)],
        0.5 * np.diff(before.bounds, axis=0)[0][columns],
    )
    half = uncertainty.quantile * np.sqrt(
        np.maximum(np.einsum("pq,qr,pr->p", gain, covariance, gain), 0.0)
    )
    of = iter(half)
    out: dict[Term, dict[str, float]] = {}
    for term in hypothesis.terms:
        estimated = term.is_estimated(hypothesis.theta[hypothesis.slice_of(term)])
        for k, p in enumerate(term.parameters):
            if estimated[k]:
                width = float(next(of)) * changes.scales.value(p, term.joint)
                out.setdefault(term, {})[p.name] = width
    return out


def _within_bounds(covariance: FloatArray, most: FloatArray) -> FloatArray:
    """A covariance without deviations above the largest ones, which physical bounds allow.

    A parameter that the recordings do not determine has an infinite variance.
    """
    variance = np.diag(covariance)
    deviation = np.sqrt(np.where(np.isfinite(variance), np.maximum(variance, 0.0), most**2))
    inside = np.where(np.isfinite(covariance), covariance, 0.0)
    inside[np.diag_indices_from(inside)] = deviation**2
    shrink = np.minimum(1.0, most / np.maximum(deviation, 1e-300))
    return np.asarray(inside * shrink[:, None] * shrink)


def _shifted(hypothesis: Hypothesis, term: Term, parameter: int, step: float) -> Hypothesis:
    """The changes with a small change of a parameter of the earlier model."""
    if term not in hypothesis.terms:
        values = np.array([p.absent_value for p in term.parameters])
        values[parameter] += step
        return hypothesis.with_term(term, values)
    theta = hypothesis.theta.copy()
    theta[hypothesis.slice_of(term).start + parameter] += step
    return hypothesis.with_theta(theta)
