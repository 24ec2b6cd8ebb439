"""A fit and its candidates, seen to first order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.first_order.responses import (
    Linear,
    Response,
    answered,
    linearized,
    simulated,
)
from pytest_twin.diagnosis.first_order.ripple import rippled
from pytest_twin.diagnosis.first_order.screen import Answers, View, candidates
from pytest_twin.diagnosis.first_order.sharpen import sharpened
from pytest_twin.diagnosis.hypothesis import Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.recorded_range import RecordedRange, hidden_at
from pytest_twin.diagnosis.search.rivals import Rival
from pytest_twin.diagnosis.verdict import STANDS_OUT


@dataclass(frozen=True, slots=True)
class Look:
    """A fit seen to first order.

    Attributes:
        around: the fit.
        linear: laws along the measured motion; None where candidates were simulated.
        view: what is left of the fit, and what may give way.
        answers: responses of the candidates.
        asked: all candidates, also those that change nothing.
        failed: candidates that were simulated and came to nothing.
    """

    around: Rival
    linear: Linear | None
    view: View
    answers: Answers
    asked: frozenset[Term]
    failed: frozenset[Term] = frozenset()

    def without(self, failed: set[Term]) -> Look:
        """What is left of it once some candidates have failed."""
        answers = Answers([r for r in self.answers.responses if r.term not in failed])
        return replace(self, answers=answers, failed=self.failed | failed)


def look_ahead(problem: Problem, best: Rival) -> Look:
    """As :func:`look_around`, for what may be added.

    Behind a gear that was named the motor moves apart from the link, as a law that would be added
    moves it: where such a joint still stands above the floor, its candidates are simulated.
    """
    linear = linearized(problem, problem.fit, best.hypothesis)
    terms = _unnamed(problem, best)
    joints = set() if linear is None else _behind_gears(problem, best, linear)
    look = _looked(problem, best, linear, [t for t in terms if t.joint not in joints], None)
    if not joints:
        return look
    left = bins(problem, problem.fit).mean(best.fitted.residual)
    near = [t for t in terms if t.joint in joints]
    found = simulated(problem, near, problem.fit, best.hypothesis, left)
    answers = Answers([*look.answers.responses, *_shown(problem, found)])
    return Look(best, None, view_of(problem, best, left), answers, frozenset(terms))


def _behind_gears(problem: Problem, best: Rival, linear: Linear) -> set[int]:
    """Joints whose gear was named and that still stand above the floor."""
    gears = {t.joint for t in best.hypothesis.terms if t.law.is_elastic_transmission}
    if not gears:
        return gears
    view = view_of(problem, best, linear.residual(best.fitted.residual))
    stands = view.above(view.mean_square, STANDS_OUT)
    return {j for j in gears if stands[j]}


def look_around(problem: Problem, best: Rival, known: Look | None = None) -> Look:
    """What is left around a fit, and what every candidate would do to it.

    Args:
        problem: what to explain.
        best: the fit.
        known: around a fit nearby, whose responses serve here too: they are of first order.
    """
    linear = linearized(problem, problem.fit, best.hypothesis)
    return _looked(problem, best, linear, _unnamed(problem, best), known)


def _unnamed(problem: Problem, best: Rival) -> list[Term]:
    named = set(best.hypothesis.terms)
    return [t for t in candidates(problem) if t not in named]


def _looked(
    problem: Problem,
    best: Rival,
    linear: Linear | None,
    terms: Sequence[Term],
    known: Look | None,
) -> Look:
    asked = frozenset() if known is None else known.asked
    new = [t for t in terms if t not in asked]
    found, left = answered(linear, problem, new, problem.fit, best.hypothesis, best.fitted.residual)
    view = view_of(problem, best, left)
    if known is not None:
        found += [r for r in known.answers.responses if r.term in terms]
    found = _shown(problem, found)
    answers = Answers(found)
    if linear is not None and known is None and found:
        more = _shown(
            problem,
            [*sharpened(linear, view, answers, best.hypothesis), *rippled(linear, view, new)],
        )
        answers = Answers([*found, *more]) if more else answers
    return Look(best, linear, view, answers, frozenset(terms))


def _shown(problem: Problem, found: Sequence[Response]) -> list[Response]:
    """Responses whose shapes lie where the recordings can show them."""
    recorded = RecordedRange.of(problem)
    return [r for r in found if not hidden_at(problem, recorded, r.term, r.start)]


def view_of(problem: Problem, best: Rival, left: FloatArray) -> View:
    """A fit whose (bins, signals) residual is ``left``."""
    binned = bins(problem, problem.fit)
    slope = binned.mean(best.fitted.jacobian)
    return View(left, slope, problem.signal_floor, binned.lengths)
