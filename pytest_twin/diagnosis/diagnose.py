"""A diagnosis from recordings to findings and the unexplained residual."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_twin.diagnosis.coarse_step import notes_on_coarse_step
from pytest_twin.diagnosis.conclusion import ChosenModel, evaluate_on_test
from pytest_twin.diagnosis.findings import Explanation, finding_json
from pytest_twin.diagnosis.longest_windows import LongWindows, errors_over_longest_windows
from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.run import Run, describe_skipped_searches
from pytest_twin.diagnosis.search_result import SearchResult
from pytest_twin.diagnosis.searched_trials import search_trials
from pytest_twin.diagnosis.signal_meaning import RecordedSignals, with_interpolation_uncertainty
from pytest_twin.diagnosis.trace import Trace
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.unexplained import UnexplainedResidual, locate_unexplained
from pytest_twin.diagnosis.unnamed_law.confirmation import (
    ConfirmedLaws,
    confirm_on_test,
    fit_laws_to_residual,
)
from pytest_twin.diagnosis.unnamed_law.fit import FreeLaws
from pytest_twin.diagnosis.verdict import JointError, Verdict, stated_verdict, verdict
from pytest_twin.diagnosis.window_length import window_of_errors
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.realization import Realization
from pytest_twin.trial import Trial


@dataclass(slots=True)
class Diagnosis:
    """Result of a diagnosis.

    Attributes:
        verdict: the conclusion in one word.
        longest_windows: errors over the longest windows that the model with the findings follows,
            if windows were predicted and all their errors are at the noise floor.
        errors: joint -> prediction error on held-out recordings, or on all recordings if none is
            held out.
        unexplained_residuals: joint -> unexplained residual, only for joints that cause it.
        notes: one line each, for the reader.
        prepared: estimation problem at the final parameters.
        candidate_count: number of effects among which the search chose.
        tested: problem, recordings and residuals from which the errors were computed.
        free: fitted free laws, for forces that no effect of the catalogue explains.
        trace: every step of the search.
        simulations: number of simulations of all recordings with as many steps.
        signals: meaning of the recorded commands, velocities and efforts.
        skipped_searches: searches that were skipped because time or simulations ran out, one line
            each.
    """

    verdict: Verdict
    longest_windows: LongWindows | None
    explanation: Explanation
    errors: Mapping[str, JointError]
    unexplained_residuals: Mapping[str, UnexplainedResidual]
    notes: tuple[str, ...]
    prepared: PreparedProblem
    candidate_count: int
    tested: SearchResult
    free: ConfirmedLaws
    trace: Trace
    simulations: float
    signals: RecordedSignals
    skipped_searches: tuple[str, ...]

    def to_json(self, *, realization: str) -> dict[str, Any]:
        """Content of ``diagnosis.json``, schema 1; errors in rad or m.

        Args:
            realization: name of the nominal model.
        """
        tested, priors = self.tested.prepared, self.explanation.priors
        return {
            "schema": 1,
            "verdict": self.verdict,
            "findings": [
                *(finding_json(f) for f in self.explanation.findings if not f.small),
                *self.free.findings_json,
            ],
            "small_corrections": [finding_json(f) for f in self.explanation.findings if f.small],
            "held_out": _errors_json(self.errors),
            **({"priors": [use.to_json() for use in priors]} if priors else {}),
            "tested_windows": window_of_errors(tested.problem),
            "longest_windows": None
            if self.longest_windows is None
            else {
                "seconds": self.longest_windows.seconds,
                "held_out": _errors_json(self.longest_windows.errors),
            },
            "floor": {
                source: dict(zip(tested.problem.joints, map(float, rms), strict=True))
                for source, rms in tested.floor_parts.items()
            },
            "unexplained": {
                joint: {
                    "fraction": round(item.fraction, 5),
                    "where": item.where.summary,
                    "windows": dict(item.where.windows),
                    **self._removed_share(joint),
                }
                for joint, item in self.unexplained_residuals.items()
            },
            "realization": realization,
            "trials": self._trials(),
            "recordings": self.signals.to_json(
                [*self.tested.trials.fit, *self.tested.trials.held_out]
            ),
            "notes": list(self.notes),
            "not_tried": list(self.skipped_searches),
            "search_trace": self.trace.to_json(),
            "cost": {"simulations": round(self.simulations, 1)},
        }

    def _removed_share(self, joint: str) -> dict[str, float]:
        """Share of the unexplained error of a joint that laws without a name remove."""
        removed = self.free.removed_share_at(joint)
        return {} if removed is None else {"unnamed_law_removes": round(removed, 5)}

    def _trials(self) -> dict[str, list[str]]:
        """Names of the recordings that were used, by role."""
        used = self.tested.trials
        return {
            "fit": _names(used.fit),
            "held_out": _names(used.held_out),
        }


def _errors_json(errors: Mapping[str, JointError]) -> dict[str, dict[str, float | str]]:
    """Errors as in ``diagnosis.json``."""
    return {
        joint: {
            "rms_before": e.before,
            "rms_after": e.after,
            "floor": e.floor,
            "unit": e.unit,
        }
        for joint, e in errors.items()
    }


def _names(trials: Sequence[Trial]) -> list[str]:
    return list(dict.fromkeys(t.path.name for t in trials))


def diagnose(
    realization: Realization,
    trials: TrialSet,
    *,
    inherited: PatchedModel | None = None,
    threads: int = 0,
    run: Run | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Diagnosis:
    """Diagnose a model: locate errors, identify effects, fit them, and test them.

    Effects are chosen and fitted without the held-out recordings. These are used once, at the end.

    Args:
        inherited: effects of an earlier diagnosis that the MJCF of ``realization`` cannot hold.
        threads: threads of batch simulations, 0 for all cores.
        run: the limits of time and simulations, and the trace; without limits by default.
        progress: called with the fraction done, 0 to 1.

    Raises:
        RecordingError: model and recordings share no joint, or angles are not in rad.
        SpecError: a controller, payload or actuator is missing in the model.
    """
    run = Run() if run is None else run
    searched = search_trials(
        realization, trials, run, inherited=inherited, threads=threads, progress=progress
    )
    signals, trials = searched.signals, searched.trials
    structure, undetermined = searched.structure, searched.undetermined
    # Simulations of candidates may diverge and overflow; such candidates are ranked last.
    with np.errstate(over="ignore", invalid="ignore"):
        progress(0.85)
        laws = _fit_laws_to_residual(structure, run)
        progress(0.88)
        evaluated = evaluate_on_test(structure, trials)
        tested, unexplained_residuals = evaluated.tested, dict[str, UnexplainedResidual]()
        stated, longest = stated_verdict(tested.verdict, tested.errors), None
        if stated in ("explained", "no_mismatch"):
            longest = errors_over_longest_windows(tested, structure.setup)
        if longest is not None:
            stated = stated_verdict(
                verdict(longest.errors, evaluated.explanation.findings), longest.errors
            )
        if stated in ("improved", "unexplained"):
            unexplained_residuals = locate_unexplained(tested, *evaluated.location)
        free = confirm_on_test(
            laws, structure.found.prepared.problem, tested, searched_all=not run.skipped_searches
        )
        progress(0.9)
        step = notes_on_coarse_step(
            tested.prepared.problem, tested.explanation.hypothesis, tested.errors
        )
    notes = [*trials.notes, *structure.notes, *evaluated.notes, *free.notes, *step]
    notes += describe_skipped_searches(run)
    progress(0.94)
    for problem in (*signals.problems, *evaluated.problems):
        run.budget.add(problem)
    explanation = with_interpolation_uncertainty(evaluated.explanation, undetermined)
    return Diagnosis(
        stated, longest, explanation, free.tested.errors, unexplained_residuals,
        tuple(dict.fromkeys(notes)),
        structure.found.prepared, structure.found.candidate_count, free.tested, free,
        run.trace, run.budget.work, signals,
        tuple(run.skipped_searches),
    )  # fmt: skip


def _fit_laws_to_residual(structure: ChosenModel, run: Run) -> FreeLaws:
    """Laws without a name for the residual, if time remains."""
    try:
        with run.budget.fitting():
            return fit_laws_to_residual(structure.setup, structure.found, structure.location_window)
    except OutOfTime:
        run.skip("a law without a name for the unexplained residual")
        return FreeLaws((), structure.found.explanation.hypothesis, ())
