"""Proposals of effects that are chosen by simulation, because no linearization leads to them.

Effects state such starts themselves (:meth:`~pytest_twin.effects.Effect.propose`): the sizes of a
limit, a soft servo, a stiffer gear with a heavier link.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.cost_screen import CostScreen
from pytest_twin.diagnosis.search.drive_limits import refine_limit_sizes
from pytest_twin.diagnosis.search.proposed_starts import starts_at
from pytest_twin.diagnosis.structure_search.score import Scorer, SimulatedModel
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.estimation.least_squares import fit

_SIMULATED = 4
"""Number of proposals that are simulated on all recordings."""
_ITERATIONS = 3
"""Of the fit of two effects that cancel only approximately."""


@dataclass(frozen=True, slots=True)
class StartPlace:
    """What a start is an alternative to: starts in the same place differ in their sizes only.

    Attributes:
        others: effects that start with it.
        replaced: effects of the joint that it replaces.
    """

    term: Term
    others: tuple[str, ...]
    replaced: tuple[Term, ...]


def propose_by_simulation(
    scorer: Scorer,
    incumbent: SimulatedModel,
    best: SimulatedModel,
    screen: CostScreen,
    terms: Sequence[Term],
) -> list[Hypothesis]:
    """The starts of effects with the smallest misfit, each refined.

    All are simulated on the recording with the largest residual, beside the effects of the
    incumbent and instead of those of their joint. An effect that is better at several joints is
    proposed at all of them together too.

    Args:
        incumbent: the model that may be replaced.
        best: the best model of this step; effects propose starts at joints that it leaves
            unexplained.
        screen: simulates on a part of the recordings.
    """
    own = incumbent.hypothesis
    found = dict[StartPlace, list[Hypothesis]]()
    unexplained = scorer.exceeds_floor(best, 2.0 * VERDICT.identifiable)
    for place, hypothesis in _starts(scorer.problem, own, terms, unexplained):
        found.setdefault(place, []).append(hypothesis)
    every = [h for sizes in found.values() for h in sizes]
    if not every:
        return []
    bare, *misfits = scorer.misfits_on_worst_recording([own, *every], best)
    misfit_of = iter(misfits)
    nearest = {
        place: min(((next(misfit_of), h) for h in sizes), key=lambda each: each[0])
        for place, sizes in found.items()
    }
    at_all_joints = _at_all_joints(own, {p: h for p, (m, h) in nearest.items() if m < bare})
    ranked = sorted(
        [
            *zip(
                scorer.misfits_on_worst_recording(at_all_joints, best), at_all_joints, strict=True
            ),
            *nearest.values(),
        ],
        key=lambda each: each[0],
    )
    chosen = [(m, h) for m, h in ranked[:_SIMULATED] if np.isfinite(m)]
    refined = [r for m, h in chosen if m < bare for r in _refine(screen, own, h)]
    return [*(h for _, h in chosen), *refined]


def _starts(
    problem: Problem, own: Hypothesis, terms: Sequence[Term], unexplained: NDArray[np.bool_]
) -> Iterator[tuple[StartPlace, Hypothesis]]:
    """Each start at an unexplained joint, beside the effects of the fit and instead of them."""
    for term in dict.fromkeys((*own.terms, *terms)):
        if term.joint < 0 or not unexplained[term.joint]:
            continue
        for start in starts_at(problem, own, term):
            others = {Term(effect, term.joint): start.others[effect] for effect in start.others}
            if others.keys() & set(own.terms):
                continue
            beside = {
                t: np.array([values.get(p.name, 0.0) for p in t.parameters])
                for t, values in others.items()
            }
            names = tuple(start.others)
            if term in own.terms:
                theta = own.theta.copy()
                theta[own.slice_of(term)] = start.parameters
                yield StartPlace(term, names, ()), own.with_theta(theta).with_terms(beside)
                continue
            of_joint = tuple(t for t in own.terms if t.joint == term.joint)
            for replaced in ((), of_joint) if of_joint else ((),):
                rest = own.without(*replaced)
                added = rest.with_terms({**beside, term: start.parameters})
                yield StartPlace(term, names, replaced), added


def _at_all_joints(own: Hypothesis, nearest: dict[StartPlace, Hypothesis]) -> list[Hypothesis]:
    """For each effect that is added at several joints: the hypothesis with it at all of them."""
    groups = dict[tuple[str, tuple[str, ...]], list[Hypothesis]]()
    for place, hypothesis in nearest.items():
        if not place.replaced and place.term not in own.terms:
            groups.setdefault((place.term.effect, place.others), []).append(hypothesis)
    out = []
    for each in groups.values():
        together = own
        for hypothesis in each:
            for t in hypothesis.terms:
                if t not in together.terms:
                    together = together.with_term_of(hypothesis, t)
        if len(each) > 1:
            out.append(together)
    return out


def _refine(screen: CostScreen, own: Hypothesis, start: Hypothesis) -> list[Hypothesis]:
    """A start with better parameters: the size of a limit, or two effects that cancel.

    The minimum of a limit may be narrow and anywhere up to its bound.
    """
    last = start.terms[-1]
    if last.law.is_limit:
        return [h for h in refine_limit_sizes(screen, [start]) if h is not start]
    changed = any(
        not np.array_equal(own.theta[own.slice_of(t)], start.theta[start.slice_of(t)])
        for t in own.terms
        if t in start.terms
    )
    if not changed:
        return []
    found = fit(screen.problem, [start], screen.weights, screen.segments, iterations=_ITERATIONS)
    return [f.hypothesis for f in found]
