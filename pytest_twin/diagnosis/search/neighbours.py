"""Models around the incumbent: effects removed, added, exchanged, and the same physics rewritten.

All come from one linearization. A set of terms is removed (none, one, two of a joint, all of a
joint), and a beam search looks for what explains the residual then. Two terms as one law, a law as
its special case, one law of the robot for several joints are neighbours like all others.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import (
    BeamSearch,
    NormalEquations,
    ResidualView,
)
from pytest_twin.diagnosis.first_order.linearized_fit import LinearizedFit, fit_linearized
from pytest_twin.diagnosis.first_order.sensitivities import starting_grid
from pytest_twin.diagnosis.search.linearized_view import View
from pytest_twin.diagnosis.search.model import Model
from pytest_twin.diagnosis.search.physics import Physics
from pytest_twin.diagnosis.search.settings import SearchSettings
from pytest_twin.estimation.comparison import Comparison, Size
from pytest_twin.estimation.hypothesis import Hypothesis, Term

_FIRST_ITERATIONS, _MORE_ITERATIONS = 1, 2
"""Iterations of the fits along the measured motion: of all neighbours, and of the best again."""
_RANKED = 4
"""Exchanges that are fitted along the motion, in multiples of those that are simulated."""


@dataclass(frozen=True, slots=True)
class Neighbour:
    """A model that may replace the incumbent, fitted along the measured motion.

    Attributes:
        hypothesis: with the fitted parameters.
        gain: predicted gain of the score over the incumbent.
        mean_square: (signals,) mean squared residual along the motion.
        difference: largest RMS difference of its prediction to that of the incumbent, in floors.
    """

    hypothesis: Hypothesis
    gain: float
    mean_square: FloatArray
    difference: float

    @property
    def has_elastic(self) -> bool:
        """Whether it has an elastic transmission."""
        return any(t.law.is_elastic_transmission for t in self.hypothesis.terms)


@dataclass(frozen=True, slots=True)
class Quota:
    """Largest numbers of neighbours: with one effect, with each larger number, and of each number
    with an elastic transmission.
    """

    single: int
    larger: int
    elastic: int

    @classmethod
    def of(cls, settings: SearchSettings, times: int = 1) -> Quota:
        """The numbers of the settings, multiplied."""
        return cls(
            times * settings.of_one_effect,
            times * settings.of_each_count,
            times * settings.of_each_elastic,
        )

    def divide(self, ranked: Iterable[Neighbour]) -> tuple[list[Neighbour], list[Neighbour]]:
        """The first neighbours with each number of effects, and the others.

        Those with an elastic transmission are counted apart: along the measured motion they seem to
        explain nearly everything, and would displace all others.
        """
        first, others, taken = list[Neighbour](), list[Neighbour](), Counter[tuple[int, bool]]()
        for neighbour in ranked:
            kind = len(neighbour.hypothesis.terms), neighbour.has_elastic
            most = self.elastic if kind[1] else self.single if kind[0] == 1 else self.larger
            (first if taken[kind] < most else others).append(neighbour)
            taken[kind] += 1
        return first, others


def neighbours(
    physics: Physics,
    comparison: Comparison,
    incumbent: Model,
    view: View,
    settings: SearchSettings,
    is_possible: Callable[[Size], bool],
) -> list[Neighbour]:
    """Neighbours of the incumbent, the most promising first.

    Args:
        physics: the robot and its recordings.
        comparison: by which they are scored.
        incumbent: the model that may be replaced.
        view: the motion linearized around it.
        is_possible: whether a model of a size may replace the incumbent or be its rival.
    """
    own = incumbent.hypothesis
    exchanged = dict[_Form, LinearizedFit]()
    for fit in _exchanges(physics, incumbent, view, settings, is_possible):
        exchanged.setdefault(form_of(fit.hypothesis), fit)
    linear, seen = view.linear, view.residual
    of_incumbent = comparison.log_likelihood(seen.mean_square) - comparison.penalty(incumbent.size)

    def neighbour(each: LinearizedFit) -> Neighbour:
        with np.errstate(over="ignore", invalid="ignore"):
            mean_square = np.mean(each.residual**2, axis=0)
            change = np.sqrt(np.mean((each.residual - seen.residual) ** 2, axis=0))
        score = comparison.log_likelihood(mean_square)
        score -= comparison.penalty(physics.size(each.hypothesis))
        difference = float(np.nan_to_num(change / seen.floor, nan=np.inf).max())
        return Neighbour(each.hypothesis, score - of_incumbent, mean_square, difference)

    # Many joints have many exchanges, and the normal equations already rank them.
    ranked = sorted(map(neighbour, exchanged.values()), key=lambda n: -n.gain)
    kept, _ = Quota.of(settings, _RANKED).divide(ranked)
    different = {form_of(n.hypothesis): n.hypothesis for n in kept}
    for hypothesis in itertools.chain(
        confused(physics, own),
        physics.rewrites(own),
        physics.sensor_effects(own, incumbent.mean_square),
    ):
        if has_given(hypothesis, physics.given):
            different.setdefault(form_of(hypothesis), hypothesis)
    different = {f: h for f, h in different.items() if is_possible(physics.size(h))}
    if linear is None:
        # Candidates were simulated; nothing is known of the same physics in other words.
        return sorted(
            [
                neighbour(exchanged[form])
                if form in exchanged
                else Neighbour(h, 0.0, seen.mean_square, np.inf)
                for form, h in different.items()
            ],
            key=lambda n: -n.gain,
        )

    def fitted(models: Sequence[Hypothesis], iterations: int) -> list[Neighbour]:
        fits = fit_linearized(linear, seen, models, iterations)
        return sorted((neighbour(f) for f in fits), key=lambda n: -n.gain)

    starts = list(different.values())
    first, others = Quota.of(settings, 2).divide(fitted(starts, _FIRST_ITERATIONS))
    again = fitted([n.hypothesis for n in first], _MORE_ITERATIONS)
    return sorted([*again, *others], key=lambda n: -n.gain)


_Form = frozenset[tuple[Term, tuple[float, ...], tuple[bool, ...]]]


def form_of(hypothesis: Hypothesis) -> _Form:
    """Terms with their discrete choices and the parameters that a fit estimates."""
    return frozenset(
        (
            t,
            tuple(float(x) for x, p in zip(own, t.parameters, strict=True) if p.choice),
            tuple(map(bool, t.is_estimated(own))),
        )
        for t in hypothesis.terms
        if len(own := hypothesis.theta[hypothesis.slice_of(t)])
    )


def has_given(hypothesis: Hypothesis, given: Collection[Term]) -> bool:
    """Whether a hypothesis has all given effects, or laws of which they are special cases."""
    return all(
        term in hypothesis.terms
        or any(t.joint == term.joint and term.effect in t.law.generalizes for t in hypothesis.terms)
        for term in given
    )


def removals(own: Hypothesis, given: Collection[Term] = ()) -> list[tuple[Term, ...]]:
    """Sets of terms that are removed: none, each, pairs of a joint, all of a joint.

    Args:
        given: terms that stay.
    """
    terms = [t for t in own.terms if t not in given]
    found = dict.fromkeys([(), *((t,) for t in terms)])
    for joint in sorted({t.joint for t in terms}):
        of_joint = [t for t in terms if t.joint in (joint, -1)]
        found.update(dict.fromkeys(itertools.combinations(of_joint, 2)))
        found[tuple(of_joint)] = None
    return list(found)


def _exchanges(
    physics: Physics,
    incumbent: Model,
    view: View,
    settings: SearchSettings,
    is_possible: Callable[[Size], bool],
) -> Iterator[LinearizedFit]:
    """The incumbent with terms removed and others added, by the normal equations."""
    own, seen = incumbent.hypothesis, view.residual
    removed_sets = removals(own, physics.given)
    reduced = [own.without(*removed) for removed in removed_sets]
    residuals = _residuals_without(physics, incumbent, view, removed_sets, reduced)
    elastic = view.sensitivities.elastic_transmissions
    rigid = {r.term for r in view.sensitivities.responses} - elastic
    for removed, rest, left in zip(removed_sets, reduced, residuals, strict=True):
        slope = seen.jacobian[:, :, own.parameters_without(*removed)]
        part = ResidualView(left, slope, seen.floor, seen.lengths)
        equations = NormalEquations(part, view.sensitivities)
        if removed:
            yield LinearizedFit(rest, equations.base.residual)
        if elastic:
            ranked = equations.children(equations.base, excluded=rigid)
            for chosen in ranked[: 2 * settings.of_each_elastic]:
                structure = equations.structure(chosen)
                yield LinearizedFit(rest.with_terms(structure.starts), structure.residual)
        most = min(len(removed) + 1, 2) if removed else settings.added
        size = physics.size(rest)
        while most and not is_possible(Size(size.effects + most, size.parameters + most)):
            most -= 1
        width = settings.beam // 2 if removed else settings.beam
        beam = BeamSearch(
            width, most, settings.earns,
            lambda before, after: bool((after < before).any()), excluded=elastic,
        )  # fmt: skip
        for level in beam.levels(equations):
            for structure in level[:width]:
                yield LinearizedFit(rest.with_terms(structure.starts), structure.residual)


def simpler_or_confused(physics: Physics, own: Hypothesis) -> list[Hypothesis]:
    """Models that need no linearization: fewer effects, other words, effects that are confused."""
    reduced = [own.without(*removed) for removed in removals(own, physics.given) if removed]
    others = [*physics.rewrites(own), *confused(physics, own)]
    every = [*reduced, *(h for h in others if has_given(h, physics.given))]
    return list({form_of(h): h for h in reversed(every)}.values())


def confused(physics: Physics, own: Hypothesis, *, carried: bool = False) -> list[Hypothesis]:
    """The incumbent with one effect exchanged for each that the catalogue confuses with it.

    Parameters with the same name and quantity keep their scaled values.

    Args:
        physics: the robot and its recordings.
        carried: whether only effects with such a parameter are exchanged. Their prediction may be
            the same, which the linearization shows for small effects only.
    """
    out = []
    for term in own.terms:
        known = {
            (p.name, p.quantity): value
            for p, value in zip(term.parameters, own.theta[own.slice_of(term)], strict=True)
            if not p.choice
        }
        for new in physics.candidates:
            listed = new.effect in term.law.confused_with or term.effect in new.law.confused_with
            same_place = term.joint < 0 or new.joint < 0 or new.joint == term.joint
            shared = known.keys() & {(p.name, p.quantity) for p in new.parameters}
            if not listed or not same_place or new in own.terms or (carried and not shared):
                continue
            for start in _start_of_each_form(new):
                for k, p in enumerate(new.parameters):
                    if (p.name, p.quantity) in known:
                        start[k] = np.clip(known[p.name, p.quantity], p.lower, p.upper)
                out.append(own.without(term).with_term(new, start))
    return out


def _start_of_each_form(term: Term) -> list[FloatArray]:
    """The first starting size of a term in each of its forms."""
    choices = [k for k, p in enumerate(term.parameters) if p.choice]
    first = dict[bytes, FloatArray]()
    for start, _ in starting_grid(term):
        first.setdefault(start[choices].tobytes(), start.copy())
    return list(first.values())


def _residuals_without(
    physics: Physics,
    incumbent: Model,
    view: View,
    removed_sets: Sequence[tuple[Term, ...]],
    reduced: Sequence[Hypothesis],
) -> list[FloatArray]:
    """(bins, signals) residual of each rest; simulated where the motion then differs widely."""
    out: dict[int, FloatArray] = {}
    if view.linear is not None:
        for k, change in enumerate(view.linear.differences(reduced)):
            left = view.residual.residual - change
            separates = any(t.law.is_elastic_transmission for t in removed_sets[k])
            if np.isfinite(left).all() and not separates:
                out[k] = left
    missing = [k for k in range(len(reduced)) if k not in out]
    if missing:
        found = physics.simulate([reduced[k] for k in missing], incumbent.corrected_at)
        out |= {k: np.nan_to_num(view.bins.mean(r)) for k, r in zip(missing, found, strict=True)}
    return [out[k] for k in range(len(reduced))]


def proposed_starts(
    physics: Physics,
    incumbent: Model,
    best: Model,
    unexplained: NDArray[np.bool_],
    most: int,
    of: Collection[Term] | None = None,
    *,
    beside: bool = True,
) -> list[Hypothesis]:
    """Starts that effects propose, because no slope leads to them: the nearest of each effect.

    They are simulated on the recording that the best model of the round explains worst. An effect
    that is nearer than the incumbent at several joints is proposed at all of them together too.

    Args:
        physics: the robot and its recordings.
        incumbent: the model that may be replaced.
        best: the best model of the round.
        unexplained: (joints,) where effects propose starts.
        most: number of starts.
        of: effects whose starts are tried; all by default.
        beside: whether also those in addition to all effects of the incumbent.
    """
    starts = [
        start
        for start in physics.starts(incumbent.hypothesis, unexplained)
        if (of is None or start[0] in of)
        and (beside or not set(incumbent.hypothesis.terms) <= set(start[1].terms))
        and has_given(start[1], physics.given)
    ]
    if not starts:
        return []
    owner = np.repeat(np.asarray(physics.recordings), physics.lengths)
    squares = np.nan_to_num(best.residual / physics.floor) ** 2
    worst = max(set(physics.recordings), key=lambda k: float(squares[owner == k].sum()))

    def misfits(hypotheses: Sequence[Hypothesis]) -> list[float]:
        parts = physics.simulate_recording(hypotheses, incumbent.corrected_at, worst)
        with np.errstate(over="ignore", invalid="ignore"):
            levels = [
                np.log(np.maximum(np.mean(r**2, axis=0), physics.floor**2)).sum() for r in parts
            ]
        return [float(x) if np.isfinite(x) else np.inf for x in levels]

    bare, *each = misfits([incumbent.hypothesis, *(h for _, h in starts)])
    nearest = dict[tuple[Term, int], tuple[float, Hypothesis]]()
    for misfit, (term, hypothesis) in zip(each, starts, strict=True):
        place = term, len(hypothesis.terms)
        if place not in nearest or misfit < nearest[place][0]:
            nearest[place] = misfit, hypothesis
    better = {place: h for place, (misfit, h) in nearest.items() if misfit < bare}
    together = _at_all_joints(incumbent.hypothesis, better)
    ranked = sorted(
        [*zip(misfits(together), together, strict=True), *nearest.values()] if together
        else list(nearest.values()),
        key=lambda pair: pair[0],
    )  # fmt: skip
    return [h for misfit, h in ranked[:most] if np.isfinite(misfit)]


def _at_all_joints(own: Hypothesis, better: dict[tuple[Term, int], Hypothesis]) -> list[Hypothesis]:
    """For each effect that helps at several joints: the hypothesis with it at all of them."""
    groups = dict[str, list[tuple[Term, Hypothesis]]]()
    for (term, _), hypothesis in better.items():
        if term not in own.terms and set(own.terms) < set(hypothesis.terms):
            groups.setdefault(term.effect, []).append((term, hypothesis))
    out = []
    for each in groups.values():
        together = own
        for term, hypothesis in each:
            if term not in together.terms:
                together = together.with_term_of(hypothesis, term)
        if together.more_terms(own) > 1:
            out.append(together)
    return out
