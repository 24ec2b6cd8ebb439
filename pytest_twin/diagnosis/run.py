"""State of a running diagnosis: its budget, its trace, and the searches that it skipped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from pytest_twin.diagnosis.budget import RESERVED_SHARE, Budget
from pytest_twin.diagnosis.likely_effect import LikelyEffect
from pytest_twin.diagnosis.problem import CandidateMask, Problem
from pytest_twin.diagnosis.trace import Decision, Step, Trace, effect_names
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class ScoredHypothesis:
    """A hypothesis with its score; the score is None before it is computed."""

    hypothesis: Hypothesis = EMPTY
    score: float | None = None


_NOTHING = ScoredHypothesis()


class Run:
    """Budget, trace and skipped searches, shared by all searches of a diagnosis.

    Attributes:
        budget: limits of time and simulations, and what was used.
        trace: every step of the searches.
        skipped_searches: searches that were skipped because time or simulations ran out, one line
            each.
        first_answer: effects of the quick diagnosis that preceded the search.
        first_values: function that returns the hypothesis with which the searches of a problem
            begin, instead of a first answer; None without one.
        mask: effects among which the searches choose; None for all.
    """

    def __init__(self, budget: Budget | None = None, trace: Trace | None = None) -> None:
        self.budget = Budget() if budget is None else budget
        self.trace = Trace() if trace is None else trace
        self.skipped_searches: list[str] = []
        self.first_answer: Sequence[LikelyEffect] = ()
        self.first_values: Callable[[Problem], Hypothesis] | None = None
        self.mask: CandidateMask | None = None

    @property
    def is_over(self) -> bool:
        """Whether time or simulations ran out, so that all searches must end."""
        return self.budget.is_out_of_time or self.budget.is_spent

    @property
    def share_done(self) -> float:
        """Share of the search that is done, 0 to 1; an estimate if its time is not limited."""
        steps = len(self.trace.steps) + self.trace.left_out
        # The number of steps is unknown: each one advances by a fixed part of the remainder.
        done = 1.0 - 0.98**steps
        if not self.budget.seconds:
            return done
        return min(
            max(done, self.budget.elapsed / ((1.0 - RESERVED_SHARE) * self.budget.seconds)), 1.0
        )

    def begin(self, stage: str, problem: Problem) -> None:
        """Start a search of ``problem``; the steps that follow belong to ``stage``."""
        self.budget.add(problem)
        self.trace.stage = stage

    def step(
        self,
        problem: Problem,
        move: str,
        decision: Decision,
        reason: str,
        proposed: ScoredHypothesis = _NOTHING,
        best: ScoredHypothesis = _NOTHING,
    ) -> None:
        """Add a step to the trace.

        Args:
            problem: the problem that is searched.
            move: kind of the step, as in :class:`~pytest_twin.diagnosis.trace.Step`.
            decision: whether the proposed hypothesis was accepted.
            reason: why, for the reader.
            proposed, best: the proposed hypothesis, and the best one before this step.
        """
        joints = problem.joints
        self.trace.add(
            Step(
                self.trace.stage,
                move,
                effect_names(joints, proposed.hypothesis.terms),
                proposed.score,
                effect_names(joints, best.hypothesis.terms),
                best.score,
                decision,
                reason,
                self.budget.work,
                self.budget.elapsed,
            )
        )

    def attempt(self, what: str, work: Callable[[], Result], otherwise: Result) -> Result:
        """Result of ``work``, or ``otherwise`` if time or simulations run out.

        Args:
            what: name of the work, for the reader.
            work: function that does it.
            otherwise: the best result so far.
        """
        if self.is_over:
            self.skip(what)
            return otherwise
        try:
            return work()
        except OutOfTime:
            self.skip(f"{what} (begun, not finished)")
            return otherwise

    def skip(self, what: str) -> None:
        """Note once that a search was skipped.

        Args:
            what: name of the search, for the reader.
        """
        if what not in self.skipped_searches:
            self.skipped_searches.append(what)


def describe_skipped_searches(run: Run) -> list[str]:
    """Note on the searches that were skipped, why, and what more time could change.

    Empty if none was skipped.
    """
    if not run.skipped_searches:
        return []
    budget = run.budget
    if budget.stopped:
        why, more = "it was stopped", "Without the interruption"
    elif budget.was_short_of_time:
        why = f"its {budget.seconds:g} processor seconds were over"
        more = "With more time (--seconds)"
    else:
        why = f"its {budget.simulations:g} simulations of all data were used"
        more = "With more recordings or a smaller model"
    skipped = "; ".join(run.skipped_searches)
    return [
        f"the search ended early, because {why}. Not tried: {skipped}. {more} "
        "further effects could be found, and effects could give way to better alternatives"
    ]
