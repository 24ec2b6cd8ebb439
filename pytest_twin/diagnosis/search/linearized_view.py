"""Linearization of a fit: its residual and the sensitivities to all candidate effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import (
    CandidateSensitivities,
    ResidualView,
    candidates,
)
from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.first_order.harmonic_search import search_harmonics
from pytest_twin.diagnosis.first_order.limit_refinement import refine_limits
from pytest_twin.diagnosis.first_order.sensitivities import (
    CLOSEST,
    Linear,
    Sensitivity,
    linearize,
    sensitivities_around,
    simulated_sensitivities,
)
from pytest_twin.diagnosis.hypothesis import Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.recorded_range import RecordedRange, hidden_at
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.verdict_settings import VERDICT


@dataclass(frozen=True, slots=True)
class LinearizedView:
    """A fit with its first-order sensitivities.

    Attributes:
        around: the fit.
        linear: its linearization; None if the candidates were simulated instead.
        view: residual of the fit, and its Jacobian with respect to its own parameters.
        candidate_sensitivities: sensitivities to the parameters of the candidates.
        evaluated: all candidates, including those without any influence.
        failed: candidates that a simulation has ruled out.
    """

    around: ScoredModel
    linear: Linear | None
    view: ResidualView
    candidate_sensitivities: CandidateSensitivities
    evaluated: frozenset[Term]
    failed: frozenset[Term] = frozenset()

    def without(self, failed: set[Term]) -> LinearizedView:
        """The same linearization without the candidates ``failed``."""
        candidate_sensitivities = CandidateSensitivities(
            [r for r in self.candidate_sensitivities.responses if r.term not in failed]
        )
        return replace(
            self, candidate_sensitivities=candidate_sensitivities, failed=self.failed | failed
        )


def linearize_for_additions(problem: Problem, best: ScoredModel) -> LinearizedView:
    """As :func:`linearize_around`, for effects that are added to the fit.

    With an elastic transmission the motor has a motion of its own, which the linearization along
    the measured link motion does not contain. If such a joint has a residual above the noise floor,
    its candidates are simulated.
    """
    linear = linearize(problem, problem.fit, best.hypothesis)
    terms = _other_candidates(problem, best)
    joints = set() if linear is None else _behind_gears(problem, best, linear)
    linearized = _view_around(
        problem, best, linear, [t for t in terms if t.joint not in joints], None
    )
    if not joints:
        return linearized
    near = [t for t in terms if t.joint in joints]
    return _simulated_view(problem, best, near, linearized.candidate_sensitivities.responses)


def _behind_gears(problem: Problem, best: ScoredModel, linear: Linear) -> set[int]:
    """Joints with a residual above the noise floor behind a gear that was found."""
    gears = {t.joint for t in best.hypothesis.terms if t.law.is_elastic_transmission}
    if not gears:
        return gears
    view = residual_view(problem, best, linear.residual(best.fitted.residual))
    above_floor = view.above(view.mean_square, VERDICT.stands_out)
    return {j for j in gears if above_floor[j]}


def linearize_around(
    problem: Problem, best: ScoredModel, known: LinearizedView | None = None
) -> LinearizedView:
    """The residual of a fit and its sensitivities to all candidates.

    Args:
        problem: the problem.
        best: the fit.
        known: linearization around a similar fit; its sensitivities are used again.
    """
    linear = linearize(problem, problem.fit, best.hypothesis)
    return _view_around(problem, best, linear, _other_candidates(problem, best), known)


def simulate_around(problem: Problem, best: ScoredModel, closest: int) -> LinearizedView:
    """As :func:`linearize_around`, with candidates that are simulated at one size.

    The linearization holds along the measured motion. Where the simulated motion is another (dry
    friction holds the joint elsewhere), it can miss what explains the difference.

    Args:
        problem: the problem.
        best: the fit.
        closest: number of candidates that are simulated at all sizes.
    """
    return _simulated_view(problem, best, _other_candidates(problem, best), (), closest)


def _simulated_view(
    problem: Problem,
    best: ScoredModel,
    terms: Sequence[Term],
    known: Sequence[Sensitivity],
    closest: int = CLOSEST,
) -> LinearizedView:
    """The view around a fit with sensitivities to ``terms`` by simulation, and known ones."""
    left = bins(problem, problem.fit).mean(best.fitted.residual)
    found = simulated_sensitivities(problem, terms, problem.fit, best.hypothesis, left, closest)
    return LinearizedView(
        best, None, residual_view(problem, best, left),
        CandidateSensitivities([*known, *_identifiable(problem, found)]),
        frozenset(_other_candidates(problem, best)),
    )  # fmt: skip


def _other_candidates(problem: Problem, best: ScoredModel) -> list[Term]:
    """Candidates that the fit does not contain."""
    named = set(best.hypothesis.terms)
    return [t for t in candidates(problem) if t not in named]


def _view_around(
    problem: Problem,
    best: ScoredModel,
    linear: Linear | None,
    terms: Sequence[Term],
    known: LinearizedView | None,
) -> LinearizedView:
    """The view around a fit, with sensitivities to ``terms``; known ones are not computed again."""
    evaluated = frozenset() if known is None else known.evaluated
    new = [t for t in terms if t not in evaluated]
    found, left = sensitivities_around(
        linear, problem, new, problem.fit, best.hypothesis, best.fitted.residual
    )
    view = residual_view(problem, best, left)
    if known is not None:
        found += [r for r in known.candidate_sensitivities.responses if r.term in terms]
    found = _identifiable(problem, found)
    candidate_sensitivities = CandidateSensitivities(found)
    if linear is not None and known is None and found:
        more = _identifiable(
            problem,
            [
                *refine_limits(linear, view, candidate_sensitivities, best.hypothesis),
                *search_harmonics(linear, view, new),
            ],
        )
        candidate_sensitivities = (
            CandidateSensitivities([*found, *more]) if more else candidate_sensitivities
        )
    return LinearizedView(best, linear, view, candidate_sensitivities, frozenset(terms))


def _identifiable(problem: Problem, found: Sequence[Sensitivity]) -> list[Sensitivity]:
    """Sensitivities whose shape parameters lie in the range that the recordings cover."""
    recorded = RecordedRange.of(problem)
    return [r for r in found if not hidden_at(problem, recorded, r.term, r.start)]


def residual_view(problem: Problem, best: ScoredModel, left: FloatArray) -> ResidualView:
    """Residual ``left``, (bins, signals), with the Jacobian of a fit averaged over the bins."""
    binned = bins(problem, problem.fit)
    slope = binned.mean(best.fitted.jacobian)
    return ResidualView(left, slope, problem.signal_floor, binned.lengths)
