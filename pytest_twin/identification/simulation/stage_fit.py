"""Fits of one stage: from several starts, and with a test on held-out motion at each joint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.physical_totals import without_negative_totals
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel, finite_differences, fit
from pytest_twin.estimation.paired_test import compare_paired
from pytest_twin.identification.simulation.passive_joints import (
    LargestBackEmf,
    has_excessive_back_emf,
    with_largest_back_emf,
)
from pytest_twin.identification.simulation.stage_effects import start, starts_of, terms_at

ITERATIONS = 8
"""Largest number of iterations of a fit."""
_ROUNDS, _SETTLED = 3, 1e-2
"""Largest number of fits until convergence; changes of parameters, in multiples of their sizes, at
which they end."""
_FIRST_ITERATIONS = 3
"""Number of iterations from each start; then only the best fit is continued."""
_FITTED = 2
"""Number of effects that are fitted in a round, because one step does not always find the best."""
LEAST_GAIN = 0.002
"""Smallest relative reduction of the error by an effect that is kept."""


def fit_terms(problem: Problem, terms: Sequence[Term], first: FloatArray) -> Hypothesis:
    """Fit terms from the first values and from the model's own values; the better fit is returned.

    Two starts are needed, because the simulation error has many minima.
    """
    if not terms:
        return EMPTY
    unknown = np.full_like(first, np.nan)
    return fit_best_start(
        problem, [start(terms, problem.scales, each) for each in (first, unknown)]
    )


def fit_best_start(problem: Problem, starts: Sequence[Hypothesis]) -> Hypothesis:
    """Continue the fit whose start has the lowest error after some iterations.

    The fit is repeated with the discretization error at its own result.
    """
    apart = [h for k, h in enumerate(starts) if all(not _are_same(h, g) for g in starts[:k])]
    weights = _weights(problem, apart)
    if len(apart) > 1:
        tried = _fit(problem, apart, weights, _FIRST_ITERATIONS)
        apart = [min(tried, key=lambda one: one.cost).hypothesis]
    (found,) = _fit(problem, apart, weights, ITERATIONS)
    return refit(problem, with_possible_totals(problem, found.hypothesis))


def refit(problem: Problem, hypothesis: Hypothesis) -> Hypothesis:
    """Fit a hypothesis again with the discretization error of the simulator at its parameters.

    That error depends on the motion: at the limit of a drive it is not that of the model's motion.
    """
    problem = problem.at(hypothesis)
    weights = _weights(problem, [hypothesis])
    (found,) = _fit(problem, [hypothesis], weights, ITERATIONS)
    return with_possible_totals(problem, found.hypothesis)


def fit_to_convergence(problem: Problem, hypothesis: Hypothesis) -> Hypothesis:
    """Fit a hypothesis until neither its parameters nor the discretization error there change.

    Parameters that compensate for one another (viscous friction and the roll-off of a drive) lie in
    a long valley, along which the discretization error changes.
    """
    for _ in range(_ROUNDS):
        found = refit(problem, hypothesis)
        moved = np.abs(found.theta - hypothesis.theta)
        hypothesis = found
        if (moved <= _SETTLED * found.sizes).all():
            break
    return hypothesis


def _fit(
    problem: Problem, starts: Sequence[Hypothesis], weights: FloatArray, iterations: int
) -> list[FittedModel]:
    """Fit, and fit again with the largest back-EMF where it exceeds the damping of its joint.

    In the second fit the back-EMF follows the damping: a bound that stays while the damping is
    fitted would hold both.
    """
    found = fit(problem, starts, weights, problem.fit, iterations=iterations, slopes=False)
    beyond = [k for k, one in enumerate(found) if has_excessive_back_emf(problem, one.hypothesis)]
    again = fit(
        LargestBackEmf(problem), [found[k].hypothesis for k in beyond], weights, problem.fit,
        iterations=iterations, slopes=False,
    )  # fmt: skip
    for k, one in zip(beyond, again, strict=True):
        bounded = with_largest_back_emf(problem, one.hypothesis)
        found[k] = replace(one, hypothesis=bounded)
    return found


def with_possible_totals(problem: Problem, hypothesis: Hypothesis) -> Hypothesis:
    """Set negative totals of model and correction to zero, because no joint drives itself."""
    return hypothesis.with_theta(without_negative_totals(problem, hypothesis))


def add_effects(
    problem: Problem,
    base: Hypothesis,
    effects: Sequence[str],
    modes: Sequence[str],
    failures: int | None = None,
) -> Hypothesis:
    """Add further effects to a fit, one in each round (forward selection).

    Each round takes one Gauss-Newton step with every remaining effect at all joints. The two with
    the lowest error on the fit recordings are fitted. The better one is tested on the held-out
    recordings at each joint. Held-out recordings thus test one effect a round and select none.

    Args:
        base: fitted terms of the stage, with the nuisance terms that are free too.
        effects: ids that may be added.
        modes: (joints,) command mode of each joint's drive.
        failures: number of consecutive effects that reduce no held-out error after which the
            selection ends; None to try all.
    """
    present = {term.effect for term in base.terms}
    slides = problem.simulator.layout.slides
    untried = [name for name in effects if name not in present and terms_at([name], modes, slides)]
    failed = 0
    while untried and failed != failures:
        here = problem.at(base)
        stepped = _try_one_step(
            here, base, {n: _with_effect_at_all_joints(base, n, modes, slides) for n in untried}
        )
        untried = [name for name in untried if name in stepped]
        if not untried:
            break
        best_of_step = sorted(untried, key=lambda each: stepped[each].cost)[:_FITTED]
        weights = _weights(here, [base])
        starts = [stepped[each].hypothesis for each in best_of_step]
        tried = _fit(here, starts, weights, ITERATIONS)
        best = min(range(len(tried)), key=lambda k: tried[k].cost)
        untried.remove(best_of_step[best])
        better = refit(problem, with_possible_totals(problem, tried[best].hypothesis))
        merged = take_better_terms(problem, base, better)
        failed += 1
        if set(merged.terms) != set(base.terms):
            base, failed = merged, 0
    return base


def take_better_terms(problem: Problem, before: Hypothesis, after: Hypothesis) -> Hypothesis:
    """Take the new terms at each joint whose held-out error they reduce significantly.

    Other joints keep their earlier terms. Terms of the whole robot are tested on all joints
    together.
    """
    errors = [_in_floors(problem, h) for h in (before, after)]
    lengths = problem.lengths(problem.tested_segments)
    whole = compare_paired(errors[0], errors[1], lengths).is_significant
    chosen: dict[Term, FloatArray] = {}
    for joint in range(-1, len(problem.joints)):
        columns = slice(None) if joint < 0 else slice(joint, joint + 1)
        own = compare_paired(errors[0][:, columns], errors[1][:, columns], lengths)
        source = after if (whole if joint < 0 else own.is_significant) else before
        for term in source.terms:
            if term.joint == joint:
                chosen[term] = source.theta[source.slice_of(term)]
    return EMPTY.with_terms(chosen)


def with_derivatives(problem: Problem, hypothesis: Hypothesis) -> FittedModel:
    """Compute the derivatives of a prediction, without changing the hypothesis."""
    problem = problem.at(hypothesis)
    weights = _weights(problem, [hypothesis])
    return fit(problem, [hypothesis], weights, problem.fit, iterations=0)[0]


def held_out_error(problem: Problem, hypothesis: Hypothesis) -> float:
    """Root mean square of all held-out position errors, in multiples of the noise floor."""
    value = float(np.sqrt(np.mean(_in_floors(problem, hypothesis) ** 2)))
    return value if np.isfinite(value) else 1e9


def _in_floors(problem: Problem, hypothesis: Hypothesis) -> FloatArray:
    """(n, joints) held-out position errors, in multiples of the noise floor.

    They are corrected for the discretization error at the parameters of the hypothesis.
    """
    residual = problem.at(hypothesis).residuals([hypothesis], problem.tested_segments)[0]
    return np.asarray(residual[:, : len(problem.joints)] / problem.floor)


def _try_one_step(
    problem: Problem, base: Hypothesis, starts: Mapping[str, Sequence[Hypothesis]]
) -> dict[str, FittedModel]:
    """Effect -> the best fit after one step from its starts; only effects that reduce the error.

    Where a start has the values of the base, the derivatives by them are those at the base.
    """
    weights = _weights(problem, [base])
    (here,) = fit(problem, [base], weights, problem.fit, iterations=0)
    every = [h for each in starts.values() for h in each]
    residual = problem.residuals(every, problem.fit)
    moved, steps, places, slopes = [], [], [], []
    for row, (h, left) in enumerate(zip(every, residual, strict=True)):
        (which,) = np.nonzero(h.is_estimated)
        shared = [t for t in base.terms if t in h.terms] if _has_values_of(h, base) else []
        kept = sum(len(t.parameters) for t in shared)
        for k, nearby, step in zip(which.tolist(), *finite_differences(h), strict=True):
            if k >= kept:
                moved.append(nearby)
                steps.append(step)
                places.append((row, k))
        columns = np.zeros((*left.shape, h.theta.size))
        for term in shared:
            columns[..., h.slice_of(term)] = here.jacobian[..., base.slice_of(term)]
        slopes.append(columns)
    for (row, k), step, left in zip(
        places, steps, problem.residuals(moved, problem.fit), strict=True
    ):
        slopes[row][..., k] = np.nan_to_num((residual[row] - left) / step)
    tried = iter(
        fit(problem, every, weights, problem.fit, iterations=1, slopes=False, jacobians=slopes)
    )
    best = {
        name: min((next(tried) for _ in each), key=lambda one: one.cost)
        for name, each in starts.items()
    }
    return {n: one for n, one in best.items() if one.cost < (1.0 - LEAST_GAIN) * here.cost}


def _with_effect_at_all_joints(
    base: Hypothesis, name: str, modes: Sequence[str], slides: Sequence[bool]
) -> list[Hypothesis]:
    """Return the base with an effect at all its joints, one hypothesis for each starting value.

    The effect replaces its special cases in the base. Starts are needed from the base and from the
    model's own values: without the limit of a drive, a fit of its gain may end far off.
    """
    found = _with_effect(base, name, modes, slides)
    bare = base.with_theta(
        np.concatenate([np.zeros(0), *(_neutral(term, base) for term in base.terms)])
    )
    return (
        found if _has_values_of(bare, base) else [*found, *_with_effect(bare, name, modes, slides)]
    )


def _neutral(term: Term, base: Hypothesis) -> FloatArray:
    """(parameters,) neutral values of a term, or its own where a parameter has none."""
    own = base.theta[base.slice_of(term)]
    return np.array([
        value if p.neutral is None else p.neutral
        for p, value in zip(term.parameters, own, strict=True)
    ])  # fmt: skip


def _has_values_of(one: Hypothesis, base: Hypothesis) -> bool:
    """Whether the terms of the base that a hypothesis has are at the base's values in it."""
    return all(
        np.array_equal(one.theta[one.slice_of(term)], base.theta[base.slice_of(term)])
        for term in base.terms
        if term in one.terms
    )


def _with_effect(
    base: Hypothesis, name: str, modes: Sequence[str], slides: Sequence[bool]
) -> list[Hypothesis]:
    """The base with an effect at all its joints, for each starting value."""
    terms = [term for term in terms_at([name], modes, slides) if term not in base.terms]
    special = {
        t: base.theta[base.slice_of(t)]
        for t in base.terms
        for term in terms
        if t.joint == term.joint and t.effect in term.law.generalizes
    }
    rest = base.without(*special)
    found = []
    for values in starts_of(name):
        begun = rest
        for term in terms:
            theta = np.array(values, dtype=np.float64)
            for old, known in special.items():
                if old.joint == term.joint:
                    shared = {p.name: v for p, v in zip(old.parameters, known, strict=True)}
                    theta = np.array([
                        shared.get(p.name, v)
                        for p, v in zip(term.parameters, theta, strict=True)
                    ])  # fmt: skip
            begun = begun.with_term(term, theta)
        found.append(begun)
    return found


def _weights(problem: Problem, hypotheses: Sequence[Hypothesis]) -> FloatArray:
    """(signals,) weights of the hypothesis with the smallest residual."""
    left = [np.mean(r**2, axis=0) for r in problem.residuals(hypotheses, problem.fit)]
    finite = [each for each in left if np.isfinite(each).all()]
    least = min(finite, key=lambda each: float(each.sum())) if finite else np.ones_like(left[0])
    return problem.weights(least)


def _are_same(one: Hypothesis, other: Hypothesis) -> bool:
    return one.terms == other.terms and bool(np.allclose(one.theta, other.theta))
