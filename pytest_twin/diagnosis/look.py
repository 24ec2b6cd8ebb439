"""A fit and its candidates, seen to first order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pytest_twin.diagnosis.hypothesis import Term
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.responses import Linear, answered, bins, linearized, simulated
from pytest_twin.diagnosis.rivals import Rival
from pytest_twin.diagnosis.screen import Answers, View, candidates
from pytest_twin.diagnosis.sharpen import sharpened
from pytest_twin.diagnosis.verdict import STANDS_OUT
from pytest_twin.effects.base import FloatArray


@dataclass(slots=True)
class Look:
    """A fit seen to first order.

    Attributes:
        linear: laws along the measured motion; None where candidates were simulated.
        view: what is left of the fit, and what may give way.
        answers: responses of the candidates.
        failed: candidates that were simulated and came to nothing.
    """

    linear: Linear | None
    view: View
    answers: Answers
    failed: frozenset[Term] = frozenset()

    def without(self, failed: set[Term]) -> Look:
        """What is left of it once some candidates have failed."""
        answers = Answers([r for r in self.answers.responses if r.term not in failed])
        return Look(self.linear, self.view, answers, self.failed | failed)


def look_ahead(problem: Problem, best: Rival) -> Look:
    """As :func:`look_around`, for what may be added.

    Behind a gear that was named the motor moves apart from the link, as a law that would be added
    moves it: where such a joint still stands above the floor, its candidates are simulated.
    """
    look = look_around(problem, best)
    joints = _behind_gears(best, look)
    if not joints or look.linear is None:
        return look
    near = [t for t in candidates(problem) if t.joint in joints and t not in best.hypothesis.terms]
    left = bins(problem, problem.fit).mean(best.fitted.residual)
    found = [r for r in look.answers.responses if r.term.joint not in joints]
    found += simulated(problem, near, problem.fit, best.hypothesis, left)
    return Look(None, view_of(problem, best, left), Answers(found))


def _behind_gears(best: Rival, look: Look) -> set[int]:
    """Joints whose gear was named and that still stand above the floor."""
    stands = look.view.above(np.mean(look.view.residual**2, axis=0), STANDS_OUT)
    gears = {t.joint for t in best.hypothesis.terms if t.law.overrides("separates")}
    return {j for j in gears if stands[j]}


def look_around(problem: Problem, best: Rival) -> Look:
    """What is left around a fit, and what every candidate would do to it."""
    named = set(best.hypothesis.terms)
    terms = [t for t in candidates(problem) if t not in named]
    linear = linearized(problem, problem.fit, best.hypothesis)
    found, left = answered(
        linear, problem, terms, problem.fit, best.hypothesis, best.fitted.residual
    )
    view, answers = view_of(problem, best, left), Answers(found)
    if linear is not None and found:
        sharp = sharpened(linear, view, answers, best.hypothesis)
        answers = Answers([*found, *sharp]) if sharp else answers
    return Look(linear, view, answers)


def view_of(problem: Problem, best: Rival, left: FloatArray) -> View:
    """A fit whose (bins, signals) residual is ``left``."""
    binned = bins(problem, problem.fit)
    slope = binned.mean(best.fitted.jacobian)
    return View(left, slope, problem.signal_floor, binned.lengths)
