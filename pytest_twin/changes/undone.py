"""The changes in a model, and undone in it: are the earlier recordings predicted as before?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.conclusion import ChosenModel
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.patched.model import PatchedModel, read_patched_model
from pytest_twin.diagnosis.patched.write import RecordingSettings, load_written, write_realization
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.settings import SETTINGS
from pytest_twin.estimation.comparison import Comparison
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.formats.temporary import temporary_folder
from pytest_twin.realization import Realization
from pytest_twin.trial import Trial

REALIZATION = "realization"
_SAME = 0.05
"""Relative difference of two RMS errors up to which recordings are predicted as before: MJCF rounds
values, and its native form of an effect is stepped otherwise."""


@dataclass(frozen=True, slots=True)
class Counterfactual:
    """RMS errors of the earlier recordings, joint -> rad or m.

    Attributes:
        known: with the model of the earlier recordings.
        undone: with the written model in which the changes are undone.
        changed: with the written model that has the changes.
    """

    known: Mapping[str, float]
    undone: Mapping[str, float]
    changed: Mapping[str, float]

    @property
    def holds(self) -> bool:
        """Whether the earlier recordings are predicted as before once the changes are undone."""
        return all(
            abs(undone - self.known[joint]) <= _SAME * max(self.known[joint], 1e-9)
            for joint, undone in self.undone.items()
        )


def not_excluded_before(
    setup: ModelSetup, earlier: Sequence[Trial], changes: PreparedProblem, hypothesis: Hypothesis
) -> frozenset[Term]:
    """Changes with which the earlier recordings are predicted as well as without them.

    These recordings do not show that the effect was absent: it may have been there before.

    Args:
        setup: the model of the earlier recordings.
        changes: the problem of the changes, whose scales they have.
        hypothesis: all changes.
    """
    scales = changes.problem.scales
    problem = setup.prepare(earlier, (), changes.window, scales=scales).problem.at(EMPTY)
    if problem.joints != changes.problem.joints or not hypothesis.terms:
        return frozenset()
    each = [
        hypothesis.without(*(t for t in hypothesis.terms if t != own)) for own in hypothesis.terms
    ]
    known, *with_one = problem.residuals([EMPTY, *each], problem.fit)
    comparison = Comparison.of(
        known, problem.signal_floor, problem.lengths(problem.fit),
        [problem.simulator.segments[s].trial for s in problem.fit], 1,
    )  # fmt: skip
    losses = [comparison.gain(known, residual) for residual in with_one]
    return frozenset(
        term
        for term, (loss, error) in zip(hypothesis.terms, losses, strict=True)
        if loss <= SETTINGS.standard_errors * error
    )


def write_changed_model(
    folder: Path,
    realization: Realization,
    known: ChosenModel,
    inherited: PatchedModel | None,
    changes: Problem,
    hypothesis: Hypothesis,
) -> Counterfactual:
    """Write the model with its changes, and compare it with one in which they are undone.

    Args:
        folder: new, empty folder of the realization.
        known: the model of the earlier recordings.
        inherited: effects of the nominal model, if an earlier diagnosis wrote it.
        changes: the problem of the changes.
        hypothesis: all changes.

    Raises:
        PathError: the folder cannot be written.
    """
    prepared = known.found.prepared
    problem, before = prepared.problem, known.found.explanation.hypothesis
    settings = RecordingSettings(prepared.cold_fractions, prepared.substeps, known.between)
    earlier = known.found.trials.fit

    def errors_of(written: Path) -> dict[str, float]:
        loaded = load_written(written)
        setup = replace(
            ModelSetup.of(loaded, read_patched_model(loaded)),
            substeps=prepared.substeps, is_of_robot=known.setup.is_of_robot,
        )  # fmt: skip
        return _errors(setup, earlier, prepared.window)

    total = _with_changes(problem, before, changes, hypothesis)
    write_realization(folder, realization, problem, total, inherited, settings)
    with temporary_folder() as scratch:
        undone = Path(scratch) / REALIZATION
        undone.mkdir()
        write_realization(undone, realization, problem, before, inherited, settings)
        of_undone = errors_of(undone)
    (errors,) = problem.at(before).errors([before], problem.fit)
    return Counterfactual(_by_joint(problem, errors), of_undone, errors_of(folder))


def _errors(
    setup: ModelSetup, trials: Sequence[Trial], window: float | None
) -> dict[str, float]:  # fmt: skip
    problem = setup.prepare(trials, (), window).problem.at(EMPTY)
    (errors,) = problem.errors([EMPTY], problem.fit)
    return _by_joint(problem, errors)


def _by_joint(problem: Problem, errors: FloatArray) -> dict[str, float]:
    """Joint -> RMS of (samples, signals) errors of its position, rad or m."""
    rms = np.sqrt(np.mean(errors[:, : len(problem.joints)] ** 2, axis=0))
    return dict(zip(problem.joints, map(float, rms), strict=True))


def _with_changes(
    problem: Problem, before: Hypothesis, changes: Problem, hypothesis: Hypothesis
) -> Hypothesis:
    """The effects before combined with the changes; shapes stay as they were.

    Args:
        problem, before: effects of the earlier recordings in their problem.
        changes, hypothesis: changes in theirs.
    """
    total = before
    for term in hypothesis.terms:
        joint = term.joint if term.joint < 0 else problem.joints.index(changes.joints[term.joint])
        own = Term(term.effect, joint)
        values = hypothesis.theta[hypothesis.slice_of(term)]
        theta = np.array([
            value * changes.scales.value(p, term.joint) / problem.scales.value(p, joint)
            for p, value in zip(term.parameters, values, strict=True)
        ])  # fmt: skip
        if own not in total.terms:
            total = total.with_term(own, theta)
            continue
        present = total.theta[total.slice_of(own)]
        scales = [problem.scales.value(p, joint) for p in own.parameters]
        every = total.theta.copy()
        every[total.slice_of(own)] = [
            old if p.neutral is None else p.combined(old * scale, new * scale) / scale
            for p, old, new, scale in zip(own.parameters, present, theta, scales, strict=True)
        ]
        total = total.with_theta(np.clip(every, *total.bounds))
    return total
