"""A fit and its candidates, seen to first order."""

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
    """A fit seen to first order.

    Attributes:
        around: the fit.
        linear: laws along the measured motion; None where candidates were simulated.
        view: residual of the fit, and the sensitivities to its own parameters.
        answers: responses of the candidates.
        asked: all candidates, also those that change nothing.
        failed: candidates that were simulated and came to nothing.
    """

    around: ScoredModel
    linear: Linear | None
    view: ResidualView
    answers: CandidateSensitivities
    asked: frozenset[Term]
    failed: frozenset[Term] = frozenset()

    def without(self, failed: set[Term]) -> LinearizedView:
        """The same view without some candidates that have failed."""
        answers = CandidateSensitivities(
            [r for r in self.answers.responses if r.term not in failed]
        )
        return replace(self, answers=answers, failed=self.failed | failed)


def linearize_for_additions(problem: Problem, best: ScoredModel) -> LinearizedView:
    """As :func:`linearize_around`, for what may be added.

    Behind a gear that was named the motor moves apart from the link, as a law that would be added
    moves it: where such a joint still has a residual, its candidates are simulated.
    """
    linear = linearize(problem, problem.fit, best.hypothesis)
    terms = _unnamed(problem, best)
    joints = set() if linear is None else _behind_gears(problem, best, linear)
    look = _looked(problem, best, linear, [t for t in terms if t.joint not in joints], None)
    if not joints:
        return look
    left = bins(problem, problem.fit).mean(best.fitted.residual)
    near = [t for t in terms if t.joint in joints]
    found = simulated_sensitivities(problem, near, problem.fit, best.hypothesis, left)
    answers = CandidateSensitivities([*look.answers.responses, *_shown(problem, found)])
    return LinearizedView(best, None, residual_view(problem, best, left), answers, frozenset(terms))


def _behind_gears(problem: Problem, best: ScoredModel, linear: Linear) -> set[int]:
    """Joints with a residual above the noise floor behind a gear that was found."""
    gears = {t.joint for t in best.hypothesis.terms if t.law.is_elastic_transmission}
    if not gears:
        return gears
    view = residual_view(problem, best, linear.residual(best.fitted.residual))
    stands = view.above(view.mean_square, VERDICT.stands_out)
    return {j for j in gears if stands[j]}


def linearize_around(
    problem: Problem, best: ScoredModel, known: LinearizedView | None = None
) -> LinearizedView:
    """The residual of a fit, and the sensitivity of it to every candidate.

    Args:
        problem: what to explain.
        best: the fit.
        known: around a fit nearby, whose responses serve here too: they are of first order.
    """
    linear = linearize(problem, problem.fit, best.hypothesis)
    return _looked(problem, best, linear, _unnamed(problem, best), known)


def _unnamed(problem: Problem, best: ScoredModel) -> list[Term]:
    named = set(best.hypothesis.terms)
    return [t for t in candidates(problem) if t not in named]


def _looked(
    problem: Problem,
    best: ScoredModel,
    linear: Linear | None,
    terms: Sequence[Term],
    known: LinearizedView | None,
) -> LinearizedView:
    asked = frozenset() if known is None else known.asked
    new = [t for t in terms if t not in asked]
    found, left = sensitivities_around(
        linear, problem, new, problem.fit, best.hypothesis, best.fitted.residual
    )
    view = residual_view(problem, best, left)
    if known is not None:
        found += [r for r in known.answers.responses if r.term in terms]
    found = _shown(problem, found)
    answers = CandidateSensitivities(found)
    if linear is not None and known is None and found:
        more = _shown(
            problem,
            [
                *refine_limits(linear, view, answers, best.hypothesis),
                *search_harmonics(linear, view, new),
            ],
        )
        answers = CandidateSensitivities([*found, *more]) if more else answers
    return LinearizedView(best, linear, view, answers, frozenset(terms))


def _shown(problem: Problem, found: Sequence[Sensitivity]) -> list[Sensitivity]:
    """Responses whose shapes lie where the recordings can show them."""
    recorded = RecordedRange.of(problem)
    return [r for r in found if not hidden_at(problem, recorded, r.term, r.start)]


def residual_view(problem: Problem, best: ScoredModel, left: FloatArray) -> ResidualView:
    """A fit whose (bins, signals) residual is ``left``."""
    binned = bins(problem, problem.fit)
    slope = binned.mean(best.fitted.jacobian)
    return ResidualView(left, slope, problem.signal_floor, binned.lengths)
