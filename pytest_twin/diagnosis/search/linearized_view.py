"""The motion linearized around a model: its residual and the sensitivities to all candidates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import (
    CandidateSensitivities,
    ResidualView,
    candidates,
)
from pytest_twin.diagnosis.first_order.bins import Bins, bins
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
from pytest_twin.estimation.hypothesis import Hypothesis, Term


@dataclass(frozen=True, slots=True)
class View:
    """The motion linearized around a model.

    Attributes:
        linear: the linearization; None where candidates were simulated instead.
        bins: bins of the samples.
        residual: residual and Jacobian of the model in bins.
        sensitivities: of the prediction to all candidates that the model lacks.
    """

    linear: Linearization | None
    bins: Bins
    residual: ResidualView
    sensitivities: CandidateSensitivities


def linearize_around(
    problem: Problem, hypothesis: Hypothesis, residual: FloatArray, jacobian: FloatArray
) -> View:
    """The motion linearized around a fitted hypothesis.

    Args:
        problem: with the corrections at the hypothesis.
        residual, jacobian: of the hypothesis on the fit recordings.
    """
    linear = linearize(problem, problem.fit, hypothesis)
    terms = _other_candidates(problem, hypothesis)
    found, left = sensitivities_around(linear, problem, terms, problem.fit, hypothesis, residual)
    view = _residual_view(problem, left, jacobian)
    found = _keep_identifiable(problem, found)
    if linear is not None and found:
        found += _keep_identifiable(
            problem,
            [
                *refine_limits(linear, view, CandidateSensitivities(found), hypothesis),
                *search_harmonics(linear, view, terms),
            ],
        )
    return View(linear, bins(problem, problem.fit), view, CandidateSensitivities(found))


def simulate_around(
    problem: Problem,
    hypothesis: Hypothesis,
    residual: FloatArray,
    jacobian: FloatArray,
    closest: int,
) -> View:
    """As :func:`linearize_around`, with candidates that are simulated at one size.

    The linearization holds along the measured motion. Where the simulated motion is another (dry
    friction holds the joint elsewhere), it can miss what explains the difference.

    Args:
        closest: number of candidates that are simulated at all sizes.
    """
    binned = bins(problem, problem.fit)
    left = binned.mean(residual)
    found = simulated_sensitivities(
        problem, _other_candidates(problem, hypothesis), problem.fit, hypothesis, left, closest
    )
    sensitivities = CandidateSensitivities(_keep_identifiable(problem, found))
    return View(None, binned, _residual_view(problem, left, jacobian), sensitivities)


def _other_candidates(problem: Problem, hypothesis: Hypothesis) -> list[Term]:
    """Candidates that a hypothesis does not contain."""
    return [t for t in candidates(problem) if t not in set(hypothesis.terms)]


def _keep_identifiable(problem: Problem, found: Sequence[Sensitivity]) -> list[Sensitivity]:
    """Sensitivities whose shape parameters lie in the range that the recordings cover."""
    recorded = RecordedRange.of(problem)
    return [r for r in found if not why_unidentifiable(problem, recorded, r.term, r.start)]


def _residual_view(problem: Problem, left: FloatArray, jacobian: FloatArray) -> ResidualView:
    """Residual ``left``, (bins, signals), with the Jacobian of a fit averaged over the bins."""
    binned = bins(problem, problem.fit)
    return ResidualView(left, binned.mean(jacobian), problem.signal_floor, binned.lengths)
