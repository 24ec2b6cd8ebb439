"""Stages that are fitted in order, then together, and again while a residual remains."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.intervals import parameter_uncertainty
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.patched.model import applied_effects
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.estimation.deadline import OutOfTime, ending_at_limit
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.identification.simulation.stage_effects import (
    EXCLUDES,
    StagePlan,
    nuisance_of,
    terms_of,
)
from pytest_twin.identification.simulation.stage_fit import (
    LEAST_GAIN,
    add_effects,
    fit_terms,
    fit_to_convergence,
    held_out_error,
    take_better_terms,
    with_derivatives,
)
from pytest_twin.identification.stages import HeldOut, Stage, StageName, judge_stage
from pytest_twin.time_limit import skips

_TOGETHER: StageName = "closed_loop"
_FAILURES = 2
"""Number of consecutive effects without a place in a stage that end their selection, when they
reduce no held-out error: the next ones explain less of the fitted recordings."""


@dataclass
class StagedFit:
    """Effects that are fitted stage by stage; a stage that is accepted is frozen.

    Attributes:
        setup: the model with its simulation settings.
        trials: recordings to fit and held-out ones.
        prepared: problem of the nominal model.
        modes: (joints,) command mode of each joint's drive.
        first: (joints, 5) first values from the equation error.
        plan: stages that are fitted, and their effects.
        found: accepted terms with their parameters.
        stage_of: term -> stage that fits it.
        stages: name -> stage.
    """

    setup: ModelSetup
    trials: TrialSet
    prepared: PreparedProblem
    modes: Sequence[str]
    first: FloatArray
    plan: StagePlan = field(default_factory=StagePlan)
    found: Hypothesis = EMPTY
    stage_of: dict[Term, StageName] = field(default_factory=dict)
    stages: dict[StageName, Stage] = field(default_factory=dict)

    def run(self, progress: Callable[[float], None]) -> None:
        """Fit all stages; ``progress`` is called with the fraction done.

        At the time limit the stage that is fitted is left out, and so are later ones.
        """
        several = len(self.plan.order) > 1
        # Each stage, all of them together, and each stage again.
        steps = len(self.plan.order) * (2 if several else 1) + 1
        for k, name in enumerate(self.plan.order):
            _attempt(f"stage {name}", partial(self._fit_stage, name))
            progress((k + 1) / steps)
        _attempt(f"stage {_TOGETHER}", self._fit_together)
        done = len(self.plan.order) + 1
        progress(done / steps)
        if _TOGETHER not in self.stages:
            return
        if several and self.found.terms and self._error(self.found) > VERDICT.identifiable:
            self._fit_again(lambda stages: progress((done + stages) / steps))
        if self.plan.last and self._error(self.found) > VERDICT.identifiable:
            _attempt("effects that no stage has", self._add_last)

    def _fit_stage(self, name: StageName) -> None:
        self.stages[name], accepted = self._stage(name, self.found)
        for term in accepted.terms:
            self.found = self.found.with_term_of(accepted, term)
            self.stage_of[term] = name

    @property
    def _problem(self) -> Problem:
        return self.prepared.problem

    def _error(self, hypothesis: Hypothesis) -> float:
        return held_out_error(self._problem, hypothesis)

    def _words(self, name: StageName, hypothesis: Hypothesis) -> tuple[str, ...]:
        """Names of a stage's effects with their places."""
        return tuple(
            f"{place_of(self._problem, t)}.{t.effect}"
            for t in hypothesis.terms
            if name in (_TOGETHER, self.stage_of.get(t, name))
        )

    def _stage(self, name: StageName, frozen: Hypothesis) -> tuple[Stage, Hypothesis]:
        """Fit one stage with the frozen terms of other stages; return its accepted terms."""
        outside_mjcf = (
            *self.setup.outside_mjcf,
            *applied_effects(frozen, self._problem.joints, self._problem.scales),
        )
        problem = (
            replace(self.setup, outside_mjcf=outside_mjcf)
            .prepare(
                self.trials.fit,
                self.trials.held_out,
                self.prepared.window,
                scales=self._problem.scales,
            )
            .problem
        )
        problem = replace(
            problem,
            floor=self._problem.floor,
            position_weights=self._problem.position_weights,
        )
        own, free = terms_of(name, self.modes), nuisance_of(name, frozen.terms, self.modes)
        without = fit_terms(problem, free, self.first)
        # The motion of the model alone may be far off, and with it its discretization error.
        both = fit_terms(problem.at(without), [*own, *free], self.first)
        fitted = take_better_terms(problem, without, both)
        fitted = add_effects(problem, fitted, self.plan.further.get(name, ()), self.modes)
        kept = fitted.without(*(t for t in fitted.terms if t in free))
        held = HeldOut(
            held_out_error(problem, without), held_out_error(problem, fitted), "noise floors"
        )
        words = self._words(name, kept)
        stage = judge_stage(Stage(name, "accepted", "", words, None, EXCLUDES[name]), held)
        if not kept.terms or held.after > (1.0 - LEAST_GAIN) * held.before:
            stage = replace(
                stage, state="not_observable", parameters=(),
                why="the motion shows none of it: at no joint does the held-out error fall by more "
                "than chance explains",
            )  # fmt: skip
        return stage, kept if stage.state == "accepted" else EMPTY

    def _fit_together(self) -> None:
        """Fit all accepted terms together in the closed loop; a stage that moves is reopened."""
        problem, found = self._problem, self.found
        if not found.terms:
            why = "no stage before was accepted: there is nothing to fit together"
            self.stages[_TOGETHER] = Stage(
                _TOGETHER, "not_observable", why, (), None, EXCLUDES[_TOGETHER]
            )
            return
        moved = fit_to_convergence(problem, found)
        before = self._error(found)
        if self._error(moved) > before:
            moved = found
        # What a frozen stage has taken up may hide an effect: with all parameters free it shows.
        # A single stage has just tried its own effects with all parameters free.
        tried = self.plan.further.get(self.plan.order[0], ()) if len(self.plan.order) == 1 else ()
        untried = [e for effects in self.plan.further.values() for e in effects if e not in tried]
        whole = add_effects(problem, moved, untried, self.modes)
        held = HeldOut(before, self._error(whole), "noise floors")
        stage = judge_stage(
            Stage(
                _TOGETHER, "accepted", "", self._words(_TOGETHER, whole), None, EXCLUDES[_TOGETHER]
            ),
            held,
        )
        self.stages[_TOGETHER] = stage
        if stage.state != "accepted":
            return
        moved_terms = self._moved_terms(whole)
        for term in whole.terms:
            self.stage_of.setdefault(term, self.plan.stage_that_adds(term.effect) or _TOGETHER)
        for name in dict.fromkeys(self.stage_of[t] for t in moved_terms):
            if name == _TOGETHER:
                continue
            self._reopen(
                name,
                "all accepted parameters fitted together move it beyond its 95 % interval or add "
                "an effect to it",
                held.before,
                held.after,
            )
        self.found = whole

    def _moved_terms(self, whole: Hypothesis) -> list[Term]:
        """Terms that are new, or whose parameters are beyond the 95 % intervals of a fit."""
        half = parameter_uncertainty(
            self._problem.at(whole), with_derivatives(self._problem, whole)
        ).half_width
        moved = []
        for term in whole.terms:
            own = whole.slice_of(term)
            if term not in self.found.terms:
                moved.append(term)
                continue
            off = np.abs(whole.theta[own] - self.found.theta[self.found.slice_of(term)])
            if np.any(off > np.maximum(half[own], 1e-9)):
                moved.append(term)
        return moved

    def _reopen(self, name: StageName, cause: str, before: float, after: float) -> None:
        """Set a stage to ``reopened`` with the reason; errors are in noise floors."""
        stage = self.stages[name]
        first = stage.why
        if stage.state == "not_observable":
            first = "fitted alone, it reduced no held-out error by more than chance explains"
        self.stages[name] = replace(
            stage,
            state="reopened",
            why=f"{first}; {cause}, and the held-out error falls from {before:.3g} to "
            f"{after:.3g} noise floors",
        )

    def _fit_again(self, progress: Callable[[int], None]) -> None:
        """Fit each stage again with what later stages have found.

        The first time a stage was fitted without the effects of later ones: a friction stage
        cannot succeed while the drive lacks its limit. All parameters are then fitted together,
        and stay as they were if the held-out error does not fall. ``progress`` is called with the
        number of stages done.
        """
        before = self._error(self.found)
        for at, name in enumerate(self.plan.order):
            progress(at)
            _attempt(f"stage {name}, with what later stages had found", partial(self._refit, name))
        error = self._error(self.found)
        if error == before:
            return
        self.stage_of = {t: name for t, name in self.stage_of.items() if t in self.found.terms}
        for name in self.plan.order:
            if name in self.stages:
                words = self._words(name, self.found)
                self.stages[name] = replace(self.stages[name], parameters=words)
        self._judge_together(before, error)

    def _judge_together(self, before: float, after: float) -> None:
        """Judge the stage of all effects again, with errors in noise floors."""
        together = self.stages[_TOGETHER]
        held = together.held_out
        held = HeldOut(before if held is None else held.before, after, "noise floors")
        words = self._words(_TOGETHER, self.found)
        self.stages[_TOGETHER] = judge_stage(replace(together, why="", parameters=words), held)

    def _add_last(self) -> None:
        """Add effects that no stage has, if they lower the held-out error."""
        before = self._error(self.found)
        whole = add_effects(
            self._problem, self.found, self.plan.last, self.modes, failures=_FAILURES
        )
        after = self._error(whole)
        if after > (1.0 - LEAST_GAIN) * before:
            return
        for term in whole.terms:
            self.stage_of.setdefault(term, _TOGETHER)
        self.found = whole
        self._judge_together(before, after)

    def _refit(self, name: StageName) -> None:
        """Fit a stage again, and keep the result if the held-out error falls."""
        error = self._error(self.found)
        others = self.found.without(*(t for t in self.found.terms if self.stage_of[t] == name))
        # Further effects stay as they are. Friction, gains and armature, which compensate for
        # one another, are free again.
        kept = [t for t in others.terms if self.plan.stage_that_adds(t.effect)]
        _, accepted = self._stage(name, others.without(*(set(others.terms) - set(kept))))
        if not accepted.terms:
            return
        proposed = others
        for term in accepted.terms:
            proposed = proposed.with_term_of(accepted, term)
        merged = take_better_terms(
            self._problem, self.found, fit_to_convergence(self._problem, proposed)
        )
        less = self._error(merged)
        if less > (1.0 - LEAST_GAIN) * error:
            return
        for term in merged.terms:
            self.stage_of.setdefault(term, name)
        self._reopen(name, "fitted again with what later stages had found", error, less)
        self.found = merged


def _attempt(what: str, work: Callable[[], None]) -> None:
    """Do a piece of work unless the run must end before it is done; it is noted then."""
    if skips(what):
        return
    try:
        with ending_at_limit():
            work()
    except OutOfTime:
        skips(what)


def place_of(problem: Problem, term: Term) -> str:
    """Name of the joint that a term acts at, or ``robot``."""
    return "robot" if term.joint < 0 else problem.joints[term.joint]
