"""One search: its problem, what it came to, and whether it explains what another does not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.evidence import Likelihood, laplace_log_likelihood, log_likelihood
from pytest_twin.diagnosis.findings import Explained, explain, joint_unit
from pytest_twin.diagnosis.hypothesis import EMPTY, Hypothesis, Scales
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.patched.model import AppliedEffect
from pytest_twin.diagnosis.prepare import Prepared
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search.cma_es_fit import fit_by_evolution, initial_covariance_root
from pytest_twin.diagnosis.search.full_drive_model import (
    fit_all_terms,
    weigh_by_removal,
    with_all_drive_terms,
)
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.pruning import PrunedModel, keep_named, prune
from pytest_twin.diagnosis.search.scored_model import ScoredModel, SelectedModel
from pytest_twin.diagnosis.search.stepwise_selection import StepwiseSelection
from pytest_twin.diagnosis.structure_search.refit import as_fitted
from pytest_twin.diagnosis.structure_search.score import Model
from pytest_twin.diagnosis.structure_search.search import Result, StructureSearch
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict import (
    LEFT_FLOORS,
    UNSEEN,
    JointError,
    Verdict,
    verdict,
)
from pytest_twin.diagnosis.window_length import model_follows_recordings
from pytest_twin.effects.contact_geoms import ContactGeoms
from pytest_twin.errors import SimulationError
from pytest_twin.realization import Realization
from pytest_twin.realization.inputs import joint_inputs
from pytest_twin.trial import Trial

# Share of the squared mismatch that may be left where a search explains what another does not.
_MOSTLY = 0.1
# Share that has to be left for names from windows to be sought over whole motions.
_SOME = 0.01
# Confidence of an effect whose alternatives were not compared.
_UNCOMPARED = 0.5


@dataclass(frozen=True, slots=True)
class SearchResult:
    """What one search came to.

    Attributes:
        prepared, trials: the problem and the recordings that it is of.
        selected, pruned, explained: what was chosen, what of it stands, and as findings.
        before, after: (samples, signals) residuals over all segments.
        errors: joint -> prediction errors on held-out recordings, or on all without any.
        verdict: in one word.
        likelihood: by which its parameters were fitted.
        whole: problem over whole motions, by whose changes findings of windows are ordered.
    """

    prepared: Prepared
    trials: TrialSet
    selected: SelectedModel
    pruned: PrunedModel
    explained: Explained
    before: FloatArray
    after: FloatArray
    errors: Mapping[str, JointError]
    verdict: Verdict
    likelihood: Likelihood = log_likelihood
    whole: Problem | None = None

    @property
    def worst(self) -> float:
        """Share of the squared mismatch that is left at the joint that keeps most."""
        return max((e.fraction for e in self.errors.values() if not e.explained), default=0.0)

    @property
    def worst_joint(self) -> int:
        """Column of the joint that keeps most, in floors."""
        joints = self.prepared.problem.joints
        levels = {j: e.after / e.floor for j, e in self.errors.items()}
        return joints.index(max(levels, key=lambda joint: levels[joint]))

    @property
    def sticks_and_slips(self) -> bool:
        """Whether the joint that keeps most rubs, by what was found, and keeps a lot."""
        joint = self.worst_joint
        error = self.errors[self.prepared.problem.joints[joint]]
        rubs = any(
            t.joint == joint and t.law.family == "friction" for t in self.explained.hypothesis.terms
        )
        return rubs and error.after > LEFT_FLOORS * error.floor

    @property
    def diverges_from_recordings(self) -> bool:
        """Whether whole motions were simulated and did not come to what was recorded."""
        whole = not all(s.amid for s in self.prepared.problem.simulator.segments)
        return whole and self.verdict in ("improved", "unexplained")

    @property
    def leaves_recordings(self) -> bool:
        """Whether windows were simulated, did not come to what was recorded, and are so long that
        the model as it came does not stay near it.
        """
        problem = self.prepared.problem
        amid = all(s.amid for s in problem.simulator.segments)
        lost = self.verdict in ("improved", "unexplained")
        return amid and lost and not model_follows_recordings(problem, self.before)

    def with_floor_of(self) -> SearchResult:
        """The same, held against the floor as another search of its problem may have lowered it."""
        errors = joint_errors(self.prepared, self.before, self.after)
        return replace(self, errors=errors, verdict=verdict(errors, self.explained.findings))

    def explains_more_than(self, other: SearchResult) -> bool:
        """Whether this explains what the other does not."""
        if not self.explained.findings:
            return False
        return self.verdict == "explained" or self.worst <= _MOSTLY < other.worst

    def beside(self, other: SearchResult) -> bool:
        """Whether this and the other explain most, both, by names of their own, and the other
        leaves what this may take: some of it all, or more than this by other names.
        """
        mine, others = ({*s.explained.hypothesis.terms} for s in (self, other))
        if not (mine and others) or max(self.worst, other.worst) > _MOSTLY:
            return False
        return other.worst > _SOME or (mine != others and self.worst < other.worst)

    def scores_better_than(self, other: SearchResult) -> bool:
        """Whether what stands of this is better than what stands of the other, prices paid; both of
        one problem.
        """
        return self._evidence(other, log_likelihood) > 0.0 and self.worst < other.worst

    def tracks_better_than(self, other: SearchResult) -> bool:
        """The same of whole motions that cannot be followed everywhere, by absolute deviations."""
        return self._evidence(other, laplace_log_likelihood) > 0.0

    def _evidence(self, other: SearchResult, likelihood: Likelihood) -> float:
        comparison = ModelComparison(self.prepared.problem)
        mine, others = (
            comparison.scored_without_fit(s.explained.hypothesis) for s in (self, other)
        )
        comparison.judge([mine], others, likelihood=likelihood)
        return mine.evidence


def search(
    prepared: Prepared, trials: TrialSet, selection: StepwiseSelection, start: Hypothesis = EMPTY
) -> SearchResult:
    """Search a problem, from the model as it came or from what was found elsewhere, and judge what
    is found.
    """
    return conclude(prepared, trials, selection, from_start(selection, start))


def conclude(
    prepared: Prepared, trials: TrialSet, selection: StepwiseSelection, selected: SelectedModel
) -> SearchResult:
    """What a search chose, gone on with where the floor falls, judged.

    The judgement uses the reserved time where the time of the search is over.
    """
    run, problem = selection.diagnosis_run, prepared.problem
    goes_on = partial(_to_the_floor, prepared, selection, selected)
    if not run.over:
        selected = run.attempt("the search with a lower noise floor", goes_on, selected)
    with run.budget.reserved():
        _weigh_untested(run, selected)
        best = selected.best
        if best.fitted.jacobian.shape[2] != best.hypothesis.theta.size:
            selected.best = selection.comparison.scored_without_fit(best.hypothesis, slopes=True)
        pruned = prune(problem, selected, hurried=run.budget.out_of_time)
        for note in pruned.notes:
            run.step(problem, "pruning", "rejected", note, best=pruned.fitted.hypothesis)
        return _searched(prepared, trials, selected, pruned)


def _weigh_untested(run: Run, selected: SelectedModel) -> None:
    """Halve the confidence of effects whose alternatives were not compared for want of time."""
    for term in selected.best.hypothesis.terms if run.over else ():
        if term not in selected.confidence:
            selected.confidence[term] = _UNCOMPARED
            run.skip(f"the comparison of {term.effect} with its alternatives")


def _to_the_floor(
    prepared: Prepared, selection: StepwiseSelection, selected: SelectedModel
) -> SelectedModel:
    """What a search came to, or one that goes on from there where the floor is far lower."""
    while True:
        best = selected.best.hypothesis
        if not best.terms or not prepared.lowers_floor(best):
            return selected
        selected = from_start(selection.anew(), best)


def from_start(selection: StepwiseSelection, start: Hypothesis) -> SelectedModel:
    """What a search chooses that begins with a hypothesis, fitted; or with what the structure
    search chooses, which needs a third of the simulations of a search from the nominal model.

    A second look, which gives up where nothing leaves less, begins with the nominal model.
    """
    comparison, budget = selection.comparison, selection.diagnosis_run.budget
    if start.terms:
        with budget.reserved():
            rival = comparison.scored_without_fit(start)
        return selection.run(comparison.settled(rival))
    if selection.share_left < 1.0:
        return selection.run()
    chosen = _structure(selection)
    with budget.reserved():
        rival = comparison.scored_without_fit(chosen.model.hypothesis, slopes=True)
    if chosen.has_left:
        selection.left_off = True
        return SelectedModel(rival, comparison.nominal, tried=comparison.tried)
    return selection.run(rival if rival.hypothesis.terms else None)


def _structure(selection: StepwiseSelection) -> Result:
    """What the structure search chooses, which is left where the selection would be."""
    problem = selection.problem

    def leave(model: Model) -> bool:
        none = np.zeros((*model.residual.shape, 0))
        return selection.leave(ScoredModel(as_fitted(problem, model, none), model.validation))

    return StructureSearch(problem, selection.diagnosis_run, leave=leave).run()


def confirm(
    prepared: Prepared, trials: TrialSet, other: SearchResult, run: Run
) -> SearchResult | None:
    """What another search found, fitted here and held against its rivals, if it explains this."""
    start = other.explained.hypothesis
    if not start.terms:
        return None
    selection = StepwiseSelection(prepared.problem, run)
    comparison = selection.comparison
    rival = comparison.settled(comparison.scored_without_fit(start))
    before, after = (residuals_everywhere(prepared.problem, h) for h in (EMPTY, rival.hypothesis))
    if not all(e.explained for e in joint_errors(prepared, before, after).values()):
        return None
    found = conclude(prepared, trials, selection, selection.run(rival))
    return found if found.verdict == "explained" else None


def refit_whole_motions(found: SearchResult, other: SearchResult) -> SearchResult:
    """What another search found in windows, fitted over the whole motions of the first.

    Names stand as they were found there: where a joint sticks and slips, whole motions part
    wherever a slide ends, and what one name changes drowns in that. What both searches named is
    sought from the values of either.
    """
    problem, named = found.prepared.problem, other.selected
    comparison = ModelComparison(problem)
    start, mine = named.best.hypothesis, found.selected.best.hypothesis
    both = start.with_values_of(mine)
    steps = initial_covariance_root(named.best.fitted, other.prepared.problem.signal_floor)
    end = _deepest(comparison, [start, both], steps)
    best = comparison.scored_without_fit(end, slopes=True)
    selected = SelectedModel(
        best, comparison.nominal, named.confidence, named.alternatives, tried=comparison.tried
    )
    return _searched(
        found.prepared, found.trials, selected, keep_named(comparison, best), laplace_log_likelihood
    )


def refit_with_full_drive(
    found: SearchResult, other: SearchResult, longer: Prepared
) -> SearchResult:
    """What both searches named and all that every drive has, at the joint that keeps most, fitted
    in windows, then in longer ones, then over the whole motions of the first.

    A fit that starts over whole motions from what short windows say ends in any of their valleys;
    where it comes from longer windows they lead it to the deepest.

    Args:
        found: by whole motions.
        other: in windows.
        longer: the problem in windows that are longer.
    """
    joint, short, whole = (
        found.worst_joint,
        ModelComparison(other.prepared.problem),
        found.prepared.problem,
    )
    mine, others = (s.explained.hypothesis for s in (found, other))
    both = others.without(*(t for t in others.terms if t not in mine.terms))
    for term in mine.terms:
        if term.joint != joint and term not in both.terms:
            both = both.with_term_of(mine, term)
    start = fit_all_terms(short, with_all_drive_terms(short.problem, both, joint))
    steps = initial_covariance_root(start.fitted, short.problem.signal_floor)
    end, middle, last = start.hypothesis, ModelComparison(longer.problem), ModelComparison(whole)
    for comparison in (middle, last):
        end = _deepest(comparison, [end], steps)
    best = last.scored_without_fit(end, slopes=True)
    pruned = keep_named(last, best)
    named = weigh_by_removal(last, best, pruned.absent)
    for term in both.terms:
        # What a search named was held against its rivals there.
        if term in other.selected.confidence:
            named.confidence[term] = other.selected.confidence[term]
            named.alternatives[term] = other.selected.alternatives[term]
    return _searched(found.prepared, found.trials, named, pruned, laplace_log_likelihood)


def _deepest(
    comparison: ModelComparison, starts: Sequence[Hypothesis], steps: FloatArray
) -> Hypothesis:
    """Where an evolution from some starts ends, the simulator's step corrected for the first."""
    problem = comparison.problem
    problem.refine_at(starts[0])
    return fit_by_evolution(problem, starts, comparison.weights(comparison.nominal), steps)


def _searched(
    prepared: Prepared,
    trials: TrialSet,
    selected: SelectedModel,
    pruned: PrunedModel,
    likelihood: Likelihood = log_likelihood,
) -> SearchResult:
    problem = prepared.problem
    explained = explain(prepared, selected, pruned, (*trials.fit, *trials.held_out))
    before, after = (residuals_everywhere(problem, h) for h in (EMPTY, explained.hypothesis))
    errors = joint_errors(prepared, before, after)
    word = verdict(errors, explained.findings)
    return SearchResult(
        prepared, trials, selected, pruned, explained, before, after, errors, word, likelihood
    )


def build_problem(
    given: ModelSetup,
    trials: TrialSet,
    notes: list[str],
    window: float | None = None,
    contact: ContactGeoms | None = None,
    scales: Scales | None = None,
) -> tuple[Prepared, TrialSet]:
    """The problem, without recordings on which the model itself diverges.

    Args:
        given: the model, and how it is stepped.
        trials: what was recorded.
        notes: gets what was left out.
        window, contact, scales: as :func:`~pytest_twin.diagnosis.prepare.prepare` has them.

    Raises:
        SimulationError: it diverges on all of them.
    """
    while True:
        everything = (*trials.fit, *trials.held_out)
        prepared = given.prepared(trials.fit, trials.held_out, window, contact, scales)
        problem = prepared.problem
        predicted = problem.predict([EMPTY], problem.everywhere)[0]
        lost = {
            prepared.segment_trial[s]
            for s, p in enumerate(predicted)
            if not np.isfinite(p.position).all()
        }
        if not lost:
            idle = _idle(given.realization, problem)
            notes += _taken_for_granted(prepared, everything, given.beside, idle)
            for joint in {*trials.unseen, *idle}:
                # So far off the floor nothing stands out of it, and no fit heeds it.
                problem.floor[problem.joints.index(joint)] = UNSEEN
            return prepared, trials
        for i in sorted(lost):
            notes.append(f"left out: {everything[i].path}: the simulation of the model diverges")
        fit = tuple(t for i, t in enumerate(everything[: len(trials.fit)]) if i not in lost)
        aside = tuple(
            t for i, t in enumerate(trials.held_out, start=len(trials.fit)) if i not in lost
        )
        if not fit:
            raise SimulationError(
                "the simulation of the model diverges under the recorded commands",
                path=everything[min(lost)].path,
                expected="a model that can be simulated through at least one recording; check its "
                "gains, inertias and timestep",
            )
        trials = replace(trials, fit=fit, held_out=aside)


def _taken_for_granted(
    prepared: Prepared,
    trials: Sequence[Trial],
    beside: Sequence[AppliedEffect],
    idle: Sequence[str],
) -> list[str]:
    """What no recording says and a diagnosis assumes, a line each."""
    problem = prepared.problem
    notes = [
        f"{e.effect} of joint {e.joint!r} is not applied: no recording contains this joint"
        for e in beside
        if not e.in_model and e.joint not in (None, *problem.joints)
    ]
    owners = prepared.segment_trial
    for i, trial in enumerate(trials):
        first = problem.simulator.segments[owners.index(i)]
        if first.start > 0.0 and first.command_time[0] > 0.0:
            notes.append(
                f"{trial.path.name}: its first {first.start:.3g} s are not used, because the "
                "command before the first recorded one is unknown"
            )
        if first.velocity is None and not first.amid and first.initial_velocity.any():
            notes.append(
                f"{trial.path.name}: the robot moves at the start and no velocity is recorded; the "
                "initial velocity is estimated from the positions"
            )
    notes += [
        f"joint {joint!r}: no recording contains commands of its servo; it is assumed to hold its "
        "initial position, and its error is not evaluated"
        for joint in idle
    ]
    return notes + _half_trusted(problem)


def _half_trusted(problem: Problem) -> list[str]:
    """A line for each joint of which some windows count by less than half of the others."""
    if not problem.trust:
        return []
    weights = np.array(list(problem.trust.values()))
    few = (weights < 0.5 * weights.max(axis=0)).sum(axis=0)
    return [
        f"joint {joint!r}: {few[j]} of {len(weights)} windows have less than half the weight, in "
        "the errors too: dry friction sticks or reverses there, and its presliding is unknown"
        for j, joint in enumerate(problem.joints)
        if few[j]
    ]


def _idle(realization: Realization, problem: Problem) -> list[str]:
    """Joints with a position servo whose setpoint nobody knows."""
    servo = problem.simulator.layout.servo
    return [
        joint
        for joint, told in zip(problem.joints, servo, strict=True)
        if told == "none"
        and any(i.mode == "position" for i in joint_inputs(realization.model, joint))
    ]


def residuals_everywhere(problem: Problem, hypothesis: Hypothesis) -> FloatArray:
    """(samples, signals) that it leaves of all segments, the step's error corrected for it."""
    problem.refine_at(hypothesis)
    return problem.residuals([hypothesis], problem.everywhere)[0]


def joint_errors(
    prepared: Prepared, before: FloatArray, after: FloatArray
) -> dict[str, JointError]:
    """Joint -> RMS errors on what is held out, or on all that is fitted without any.

    Args:
        prepared: the problem.
        before, after: (samples, signals) residuals over all segments, without and with effects.
    """
    problem = prepared.problem
    inside = problem.in_test
    travel = np.ptp(
        np.concatenate([problem.simulator.segments[s].position for s in problem.tested]), axis=0
    )
    found = {}
    for j, joint in enumerate(problem.joints):
        if problem.floor[j] >= UNSEEN:
            continue
        rms = [float(np.sqrt(np.mean(r[inside, j] ** 2))) for r in (before, after)]
        floor, unit = float(problem.floor[j]), joint_unit(problem, j)
        found[joint] = JointError(rms[0], rms[1], floor, unit, float(travel[j]))
    return found
