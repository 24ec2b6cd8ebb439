"""Linearization of a fit: its residual and the sensitivities to all candidate effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
    Linearization,
    Sensitivity,
    linearize,
    sensitivities_around,
    simulated_sensitivities,
)
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.recorded_range import RecordedRange, why_unidentifiable
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.estimation.hypothesis import Term


@dataclass(frozen=True, slots=True)
class LinearizedView:
    """A fit with its first-order sensitivities.

    Attributes:
        linear: its linearization; None if the candidates were simulated instead.
        view: residual of the fit, and its Jacobian with respect to its own parameters.
        candidate_sensitivities: sensitivities to the parameters of the candidates.
    """

    around: ScoredModel
    linear: Linearization | None
    view: ResidualView
    candidate_sensitivities: CandidateSensitivities


def linearize_around(best: ScoredModel) -> LinearizedView:
    """The residual of a fit and its sensitivities to all candidates."""
    problem = best.problem
    linear = linearize(problem, problem.fit, best.hypothesis)
    terms = _other_candidates(best)
    found, left = sensitivities_around(
        linear, problem, terms, problem.fit, best.hypothesis, best.fitted.residual
    )
    view = residual_view(best, left)
    found = _keep_identifiable(problem, found)
    if linear is not None and found:
        found += _keep_identifiable(
            problem,
            [
                *refine_limits(linear, view, CandidateSensitivities(found), best.hypothesis),
                *search_harmonics(linear, view, terms),
            ],
        )
    return LinearizedView(best, linear, view, CandidateSensitivities(found))


def simulate_around(best: ScoredModel, closest: int) -> LinearizedView:
    """As :func:`linearize_around`, with candidates that are simulated at one size.

    The linearization holds along the measured motion. Where the simulated motion is another (dry
    friction holds the joint elsewhere), it can miss what explains the difference.

    Args:
        closest: number of candidates that are simulated at all sizes.
    """
    problem = best.problem
    left = bins(problem, problem.fit).mean(best.fitted.residual)
    found = simulated_sensitivities(
        problem, _other_candidates(best), problem.fit, best.hypothesis, left, closest
    )
    sensitivities = CandidateSensitivities(_keep_identifiable(problem, found))
    return LinearizedView(best, None, residual_view(best, left), sensitivities)


def _other_candidates(best: ScoredModel) -> list[Term]:
    """Candidates that the fit does not contain."""
    named = set(best.hypothesis.terms)
    return [t for t in candidates(best.problem) if t not in named]


def _keep_identifiable(problem: Problem, found: Sequence[Sensitivity]) -> list[Sensitivity]:
    """Sensitivities whose shape parameters lie in the range that the recordings cover."""
    recorded = RecordedRange.of(problem)
    return [r for r in found if not why_unidentifiable(problem, recorded, r.term, r.start)]


def residual_view(best: ScoredModel, left: FloatArray) -> ResidualView:
    """Residual ``left``, (bins, signals), with the Jacobian of a fit averaged over the bins."""
    problem = best.problem
    binned = bins(problem, problem.fit)
    slope = binned.mean(best.fitted.jacobian)
    return ResidualView(left, slope, problem.signal_floor, binned.lengths)
