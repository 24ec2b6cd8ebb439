"""Final parameters of the chosen effects, and their errors on the test recordings.

The parameters are fitted before a test recording is used.
Nothing is fitted or chosen afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from pytest_twin.diagnosis.build_problem import build_problem, residuals_everywhere
from pytest_twin.diagnosis.findings import (
    Explanation,
    held_out_gains,
    limit_contradicted_confidence,
    limit_untested_confidence,
    with_gains,
    with_unexplained_share,
)
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search_result import SearchResult, joint_errors
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.unit_check import drop_other_units
from pytest_twin.diagnosis.verdict import verdict
from pytest_twin.errors import RecordingError, SimulationError, TwinError
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Scales, Term
from pytest_twin.recording_options import CommandBetween
from pytest_twin.trial import Trial


@dataclass(frozen=True, slots=True)
class ChosenModel:
    """The chosen effects with their final parameters, before any test recording is used.

    Attributes:
        setup: the model with its simulation settings.
        found: result of the search with the final parameters.
        location_window: length in s of the windows in which the unexplained residual is located;
            None if the problem of ``found`` is used.
        notes: one line each, for the reader.
        between: interpolation of the commands between their stamps, if only the effects decided
            it.
    """

    setup: ModelSetup
    found: SearchResult
    location_window: float | None
    notes: tuple[str, ...]
    between: CommandBetween | None = None


@dataclass(frozen=True, slots=True)
class TestedModel:
    """The chosen model, evaluated on the test recordings.

    Attributes:
        explanation: the findings, with their gains on the test recordings.
        tested: errors and verdict. Its problem holds out the test recordings, and has only the
            joints that they contain.
        location: problem and trials in which the unexplained residual is located.
        notes: one line each, for the reader.
        problems: problems that were built, for the budget.
    """

    explanation: Explanation
    tested: SearchResult
    location: tuple[PreparedProblem, TrialSet]
    notes: tuple[str, ...]
    problems: tuple[Problem, ...]


def evaluate_on_test(structure: ChosenModel, trials: TrialSet) -> TestedModel:
    """Predict the held-out recordings, which were not used before.

    If none is usable, errors are those of the fitted recordings.

    Args:
        trials: all trials; they say which encoders are stuck.
    """
    found, notes = structure.found, list[str]()
    test = _usable_recordings(structure, trials.held_out, notes)
    if test:
        try:
            return _evaluate(structure, trials, test, notes)
        except (RecordingError, SimulationError) as error:
            notes.append(f"left out: {error}")
    notes.append("no recording was held out: errors and gains are those of the fitted recordings")
    location, added = _location_problem(structure, found)
    return TestedModel(
        limit_untested_confidence(found.explanation), found, location, tuple(notes), added
    )


def _evaluate(
    structure: ChosenModel, trials: TrialSet, test: tuple[Trial, ...], notes: list[str]
) -> TestedModel:
    """The chosen model on usable test recordings.

    Raises:
        RecordingError, SimulationError: no test recording can be simulated.
    """
    found = structure.found
    fitted = found.prepared
    joints = [j for j in fitted.problem.joints if all(j in t.joints for t in test)]
    column = {fitted.problem.joints.index(j): k for k, j in enumerate(joints)}
    for j in fitted.problem.joints:
        lacking = [t.path.name for t in test if j not in t.joints]
        if lacking:
            lack = "lacks" if len(lacking) == 1 else "lack"
            notes.append(f"joint {j!r} is not tested: {', '.join(lacking)} {lack} it")
    scales = Scales({name: of[list(column)] for name, of in fitted.problem.scales.of.items()})
    both = replace(found.trials, held_out=test, unseen=trials.unseen | trials.untested)
    setup = replace(structure.setup, cold_fractions=fitted.cold_fractions)
    prepared, kept = build_problem(setup, both, notes, window=fitted.window, scales=scales)
    if not kept.held_out:
        raise SimulationError(
            "the simulation of the model diverges on every held-out recording",
            path=test[0].path,
            expected="a recording through which the model can be simulated",
        )
    problem = prepared.problem
    at_tested = Explanation(
        found.explanation.findings,
        hypothesis_at_tested_joints(found.explanation.hypothesis, column),
        reduced_models={
            _term_at_tested_joints(t, column): hypothesis_at_tested_joints(rest, column)
            for t, rest in found.explanation.reduced_models.items()
            if _is_tested(t, column)
        },
    )
    prepared = prepared.with_lower_floor(at_tested.hypothesis) or prepared
    problem = prepared.problem
    gains = held_out_gains(problem, at_tested)
    explanation = with_gains(
        found.explanation,
        {
            t: gains[_term_at_tested_joints(t, column)] if _is_tested(t, column) else 0.0
            for t in found.explanation.hypothesis.terms
        },
    )
    explanation = limit_contradicted_confidence(explanation, notes)
    before, after = (residuals_everywhere(problem, h) for h in (EMPTY, at_tested.hypothesis))
    errors = joint_errors(prepared, before, after)
    explanation = with_unexplained_share(explanation, errors)
    tested = replace(
        found,
        prepared=prepared,
        trials=kept,
        explanation=replace(at_tested, findings=explanation.findings),
        before=before,
        after=after,
        errors=errors,
        verdict=verdict(errors, explanation.findings),
    )
    location, added = _location_problem(structure, tested)
    return TestedModel(explanation, tested, location, tuple(notes), (problem, *added))


def _location_problem(
    structure: ChosenModel, tested: SearchResult
) -> tuple[tuple[PreparedProblem, TrialSet], tuple[Problem, ...]]:
    """Problem in which the unexplained residual is located, and the problems that were built."""
    own = tested.prepared, tested.trials
    if structure.location_window is None or tested.verdict not in ("improved", "unexplained"):
        return own, ()
    setup = replace(structure.setup, cold_fractions=tested.prepared.cold_fractions)
    scales = tested.prepared.problem.scales
    windows = build_problem(
        setup, tested.trials, [], window=structure.location_window, scales=scales
    )
    return windows, (windows[0].problem,)


def _usable_recordings(
    structure: ChosenModel, test: Sequence[Trial], notes: list[str]
) -> tuple[Trial, ...]:
    """Test recordings without those in another unit; a note for each that is left out."""
    if not test:
        return ()
    alone = TrialSet(tuple(test), (), ())
    try:
        return drop_other_units(structure.setup.realization, alone, notes).fit
    except TwinError as error:
        notes.append(f"left out: {error}")
        return ()


def _is_tested(term: Term, column: Mapping[int, int]) -> bool:
    """Whether the joint of a term is among the tested ones."""
    return term.joint < 0 or term.joint in column


def _term_at_tested_joints(term: Term, column: Mapping[int, int]) -> Term:
    """A term in the numbering of the tested joints."""
    return Term(term.effect, column.get(term.joint, -1))


def hypothesis_at_tested_joints(hypothesis: Hypothesis, column: Mapping[int, int]) -> Hypothesis:
    """A hypothesis in the numbering of the tested joints, without terms at other joints."""
    tested = hypothesis.without(*(t for t in hypothesis.terms if not _is_tested(t, column)))
    return Hypothesis(tuple(_term_at_tested_joints(t, column) for t in tested.terms), tested.theta)
