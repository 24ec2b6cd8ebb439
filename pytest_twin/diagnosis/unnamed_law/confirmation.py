"""Test of free laws on the test recordings, which were not used for their fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.build_problem import build_problem, residuals_everywhere
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search_result import SearchResult, joint_errors
from pytest_twin.diagnosis.unexplained import locate_unexplained
from pytest_twin.diagnosis.unnamed_law.fit import FreeLaws, fit_free_laws
from pytest_twin.diagnosis.unnamed_law.law import FreeLaw, law_json
from pytest_twin.diagnosis.unnamed_law.settings import FREE_LAWS
from pytest_twin.diagnosis.windows import WINDOW
from pytest_twin.estimation.hypothesis import Hypothesis, Term


@dataclass(frozen=True, slots=True)
class ConfirmedLaws:
    """Free laws that the test recordings confirm.

    Attributes:
        laws: laws, each with the share of the squared test error that it removes.
        hypothesis: the findings and the laws, in the numbering of the fitted problem.
        tested: the result on the test recordings, with errors after the laws; its verdict and
            findings are those of the catalogue's effects alone.
        notes: one line each.
    """

    laws: tuple[tuple[FreeLaw, float], ...]
    hypothesis: Hypothesis
    tested: SearchResult
    notes: tuple[str, ...]

    @property
    def findings_json(self) -> list[dict[str, Any]]:
        """The laws as findings of ``diagnosis.json``; they follow the catalogue's effects."""
        return [law_json(law, gain) for law, gain in self.laws]

    def removed_share_at(self, joint: str) -> float | None:
        """Share of the squared test error that the laws at a joint remove; None without a law."""
        gains = [gain for law, gain in self.laws if law.joint == joint]
        return max(gains, default=None)


def fit_laws_to_residual(
    setup: ModelSetup, found: SearchResult, location_window: float | None
) -> FreeLaws:
    """Free laws for the residual that a search leaves unexplained.

    Args:
        setup: the model with its simulation settings.
        found: the result with its final parameters; all of its recordings may be used.
        location_window: length in s of the windows in which the residual is located; None for the
            segments of the problem.
    """
    hypothesis = found.explanation.hypothesis
    if found.verdict not in ("improved", "unexplained"):
        return FreeLaws((), hypothesis, ())
    prepared, trials = found.prepared, found.trials
    if not all(s.starts_in_motion for s in prepared.problem.simulator.segments):
        # In short windows the measured motion and the simulated one stay close.
        scales = prepared.problem.scales
        prepared, trials = build_problem(
            setup, trials, [], window=location_window or WINDOW, scales=scales
        )
    left = locate_unexplained(found, prepared, trials)
    where = {joint: item.where for joint, item in left.items()}
    return fit_free_laws(prepared, hypothesis, where, prepared.problem.fit)


def confirm_on_test(
    found: FreeLaws, fitted: Problem, tested: SearchResult, *, searched_all: bool = True
) -> ConfirmedLaws:
    """Predict the test recordings with the laws, and drop laws that remove too little of the error.

    Args:
        fitted: the problem to whose joints they refer.
        tested: the result on the test recordings.
        searched_all: whether the search over the catalogue was completed; otherwise confidences are
            at most 50 %.
    """
    problem, named = tested.prepared.problem, tested.explanation.hypothesis
    laws = found.laws if tested.verdict in ("improved", "unexplained") else ()
    column = {fitted.joints.index(j): k for k, j in enumerate(problem.joints)}
    kept, notes = [], list(found.notes)
    for law in laws:
        if law.term.joint not in column:
            notes.append(f"no free law at joint {law.joint}: no test recording shows this joint")
            continue
        kept.append(law)
    while kept:
        terms = {law.term: _at_tested_joint(law.term, column) for law in kept}
        everything = _with_laws(named, found.hypothesis, terms)
        after = residuals_everywhere(problem, everything)
        whole = _squared(problem, after)
        gains = []
        for law in kept:
            without = everything.without(terms[law.term])
            gains.append(_gain(_squared(problem, residuals_everywhere(problem, without)), whole))
        worst = int(np.argmin(gains))
        if gains[worst] >= FREE_LAWS.removes:
            if not searched_all:
                kept = [
                    replace(law, confidence=min(law.confidence, FREE_LAWS.most_if_early))
                    for law in kept
                ]
                notes.append(
                    "the search over known effects ended early: a known effect may explain what "
                    "the fitted law does"
                )
            errors = joint_errors(tested.prepared, tested.before, after)
            removed = [law.term for law in found.laws if law.term not in terms]
            return ConfirmedLaws(
                tuple(zip(kept, gains, strict=True)),
                found.hypothesis.without(*removed),
                replace(tested, after=after, errors=errors),
                tuple(notes),
            )
        law = kept.pop(worst)
        notes.append(
            f"no free law at joint {law.joint}: {law.words} removes "
            f"{100 * law.removed:.0f} % of the squared error in cross-validation, but "
            f"{100 * gains[worst]:.0f} % on the test recordings "
            f"({100 * FREE_LAWS.removes:.0f} % required)"
        )
    free = found.hypothesis.without(*(law.term for law in found.laws))
    return ConfirmedLaws((), free, tested, tuple(notes))


def _at_tested_joint(term: Term, column: Mapping[int, int]) -> Term:
    """A term in the numbering of the tested joints."""
    return Term(term.effect, column[term.joint])


def _with_laws(named: Hypothesis, laws: Hypothesis, terms: Mapping[Term, Term]) -> Hypothesis:
    """The findings ``named`` with laws in addition; ``terms`` maps laws to renumbered terms."""
    out = named
    for term, here in terms.items():
        out = out.with_term(here, laws.theta[laws.slice_of(term)])
    return out


def _squared(problem: Problem, residual: FloatArray) -> float:
    """Sum of squared errors of the test recordings, in noise floors."""
    return float(np.sum((residual[problem.is_in_test] / problem.signal_floor) ** 2))


def _gain(without: float, with_it: float) -> float:
    """Removed share of a squared error; 1 if it diverges without the law, -1 with it."""
    if not np.isfinite(with_it):
        return -1.0
    if not np.isfinite(without):
        return 1.0
    return float(np.clip((without - with_it) / without, -1.0, 1.0)) if without > 0.0 else 0.0
