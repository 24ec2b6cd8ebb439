"""Models that one step proposes: effects added, removed, and exchanged for others.

All proposals come from one linearization of the incumbent along the measured motion. A set of terms
is removed (none, one, two of a joint, all of a joint), and a beam search looks for what best
explains the residual then. Rewritings that mean the same physics (two terms as one law, a law as
its special case, one law of the whole robot for several joints) are proposals like all others.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import (
    BeamSearch,
    NormalEquations,
    ResidualView,
    candidates,
)
from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.first_order.linearized_fit import LinearizedFit, fit_linearized
from pytest_twin.diagnosis.first_order.sensitivities import starts_in_first_form
from pytest_twin.diagnosis.search.linearized_evidence import linearized_evidence
from pytest_twin.diagnosis.search.linearized_view import LinearizedView
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search.simplification import (
    equal_sized_forms,
    merge_joints,
    merge_terms,
    simpler_forms,
    special_cases,
    split_terms,
)
from pytest_twin.diagnosis.structure_search.score import Scorer
from pytest_twin.diagnosis.structure_search.settings import StructureSearchSettings
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.estimation.hypothesis import Hypothesis, Term

_ITERATIONS = 3
"""Of a fit along the motion."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """A model that may replace the incumbent.

    Attributes:
        hypothesis: fitted along the measured motion.
        gain: predicted log-likelihood ratio over the incumbent, prices paid.
        mean_square: (signals,) mean squared residual along the measured motion.
    """

    hypothesis: Hypothesis
    gain: float
    mean_square: FloatArray


def propose_models(
    scorer: Scorer, linearized: LinearizedView, settings: StructureSearchSettings
) -> list[Proposal]:
    """Proposals around the incumbent, most promising first.

    Args:
        linearized: the incumbent, linearized, with the responses of all candidates.
    """
    own = linearized.around.hypothesis
    pool: dict[tuple[frozenset[Term], bytes], Hypothesis] = {}
    for hypothesis in itertools.chain(
        _exchange_terms(scorer, linearized, settings),
        _rewrite(scorer, own),
        effort_sensor_terms(linearized.around),
    ):
        theta = hypothesis.theta
        form = np.array([
            estimated for t in sorted(hypothesis.terms)
            for estimated in t.is_estimated(theta[hypothesis.slice_of(t)])
        ])  # fmt: skip
        pool.setdefault((frozenset(hypothesis.terms), form.tobytes()), hypothesis)
    starts = list(pool.values())
    linear = linearized.linear
    if linear is None:
        return [Proposal(h, 0.0, linearized.view.mean_square) for h in starts]
    incumbent = LinearizedFit(own, linearized.view.residual)

    def fitted(models: Sequence[Hypothesis], iterations: int) -> list[Proposal]:
        fits = fit_linearized(linear, linearized.view, models, iterations)
        found = list[Proposal]()
        for elastic in (False, True):
            # The residual that an elastic transmission seems to leave would set the scale for all.
            some = [f for f in fits if has_new_elastic(f.hypothesis, own) == elastic]
            worth = linearized_evidence(
                linearized.view, [incumbent, *some], scorer.penalty_per_effect
            )
            gains = np.nan_to_num(worth[1:] - worth[0], nan=-np.inf)
            found += [
                Proposal(f.hypothesis, float(g), np.mean(f.residual**2, axis=0))
                for f, g in zip(some, gains, strict=True)
            ]
        return sorted(found, key=lambda p: -p.gain)

    first = fitted(starts, 1)
    kept, others = best_of_each_size(first, Quota.of(settings, 2))
    return sorted(
        [*fitted([p.hypothesis for p in kept], _ITERATIONS - 1), *others], key=lambda p: -p.gain
    )


def has_new_elastic(hypothesis: Hypothesis, own: Hypothesis) -> bool:
    """Whether a hypothesis has an elastic transmission that another one lacks."""
    return any(t.law.is_elastic_transmission for t in hypothesis.terms if t not in own.terms)


@dataclass(frozen=True, slots=True)
class Quota:
    """Largest numbers of proposals: with one effect, with each larger number, and of each number
    with an elastic transmission.
    """

    single: int
    larger: int
    elastic: int

    @classmethod
    def of(cls, settings: StructureSearchSettings, times: int = 1) -> Quota:
        """The numbers of the settings, multiplied."""
        return cls(
            times * settings.of_one_effect,
            times * settings.of_each_count,
            times * settings.of_each_elastic,
        )

    def most(self, effects: int, *, elastic: bool) -> int:
        """Largest number of proposals with so many effects."""
        return self.elastic if elastic else self.single if effects == 1 else self.larger


def best_of_each_size(
    ranked: Sequence[Proposal], quota: Quota
) -> tuple[list[Proposal], list[Proposal]]:
    """The first proposals with each number of effects, and the others.

    Proposals with an elastic transmission are counted apart: along the measured motion they seem
    to explain nearly everything, and would displace all others.

    Args:
        ranked: best first.
        quota: how many of each kind.
    """
    kept, others, taken = list[Proposal](), list[Proposal](), Counter[tuple[int, bool]]()
    for proposal in ranked:
        terms = proposal.hypothesis.terms
        count, elastic = len(terms), any(t.law.is_elastic_transmission for t in terms)
        fits = taken[count, elastic] < quota.most(count, elastic=elastic)
        (kept if fits else others).append(proposal)
        taken[count, elastic] += 1
    return kept, others


def _exchange_terms(
    scorer: Scorer, linearized: LinearizedView, settings: StructureSearchSettings
) -> Iterable[Hypothesis]:
    """The incumbent with terms removed and others added."""
    own, view = linearized.around.hypothesis, linearized.view
    removed_sets = removals(own)
    reduced = [own.without(*removed) for removed in removed_sets]
    residuals = _residuals(linearized, removed_sets, reduced)
    candidate_sensitivities = linearized.candidate_sensitivities
    elastic = candidate_sensitivities.elastic_transmissions
    rigid = {r.term for r in candidate_sensitivities.responses} - elastic

    def search(most: int, width: int) -> BeamSearch:
        return BeamSearch(
            width, most, settings.earns,
            lambda before, after: bool((after < before).any()), excluded=elastic,
        )  # fmt: skip

    for removed, rest, left in zip(removed_sets, reduced, residuals, strict=True):
        if removed:
            yield rest
        slope = view.jacobian[:, :, own.parameters_without(*removed)]
        seen = ResidualView(left, slope, view.floor, view.lengths)
        equations = NormalEquations(seen, candidate_sensitivities)
        if elastic:
            for chosen in equations.children(
                equations.base, 2 * settings.of_each_elastic, excluded=rigid
            ):
                yield rest.with_terms(equations.structure(chosen).starts)
        most = settings.added if not removed else min(len(removed) + 1, 2)
        width = settings.beam if not removed else settings.beam // 2
        for level in search(most, width).levels(equations):
            for structure in level[:width]:
                yield rest.with_terms(structure.starts)


def removals(own: Hypothesis) -> list[tuple[Term, ...]]:
    """Sets of terms that are taken away: none, each, pairs of a joint, all of a joint."""
    found: dict[tuple[Term, ...], None] = {(): None}
    found.update(dict.fromkeys((t,) for t in own.terms))
    for joint in sorted({t.joint for t in own.terms}):
        mine = [t for t in own.terms if t.joint in (joint, -1)]
        found.update(dict.fromkeys(itertools.combinations(mine, 2)))
        if len(mine) > 1:
            found[tuple(mine)] = None
    return list(found)


def _residuals(
    linearized: LinearizedView,
    removed_sets: Sequence[tuple[Term, ...]],
    reduced: Sequence[Hypothesis],
) -> list[FloatArray]:
    """(bins, signals) residual of each rest; simulated where the motion then differs widely."""
    problem, view = linearized.around.problem, linearized.view
    out: dict[int, FloatArray] = {}
    if linearized.linear is not None:
        for k, d in enumerate(linearized.linear.differences(reduced)):
            left = view.residual - d
            separates = any(t.law.is_elastic_transmission for t in removed_sets[k])
            if np.isfinite(left).all() and not separates:
                out[k] = left
    missing = [k for k in range(len(reduced)) if k not in out]
    if missing:
        binned = bins(problem, problem.fit)
        found = problem.residuals([reduced[k] for k in missing], problem.fit)
        out |= {k: np.nan_to_num(binned.mean(r)) for k, r in zip(missing, found, strict=True)}
    return [out[k] for k in range(len(reduced))]


def _rewrite(scorer: Scorer, own: Hypothesis) -> list[Hypothesis]:
    """The same physics in other words."""
    problem = scorer.problem
    return [
        *merge_terms(problem, own),
        *merge_joints(problem, own),
        *special_cases(problem, own),
        *split_terms(problem, own),
        *simpler_forms(problem, own),
        *equal_sized_forms(own),
    ]


def effort_sensor_terms(best: ScoredModel) -> list[Hypothesis]:
    """The fit with one effort sensor effect in addition, at joints with a large effort residual.

    The linearized search compares means over bins with the noise floor of single samples, so it may
    miss an offset of the effort that is below the floor in each bin.
    """
    problem = best.problem
    joints = len(problem.joints)
    (out,) = np.nonzero(
        (best.max_mean_square > VERDICT.identifiable**2 * problem.signal_floor**2)[joints:]
    )
    return [
        best.hypothesis.with_term(t, starts_in_first_form(t)[0])
        for t in candidates(problem)
        if t.law.overrides("sense_effort") and t.joint in out and t not in best.hypothesis.terms
    ]
