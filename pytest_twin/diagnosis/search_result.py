"""The result of one search, and comparisons of two results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.effect_selection import EffectSelection
from pytest_twin.diagnosis.findings import Explanation, build_explanation, joint_unit
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.patched.model import AppliedEffect
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.replacement import replace_closest_known
from pytest_twin.diagnosis.run import Run, ScoredHypothesis
from pytest_twin.diagnosis.search.cma_es_fit import fit_by_evolution, initial_covariance_root
from pytest_twin.diagnosis.search.full_drive_model import (
    fit_all_terms,
    weigh_by_removal,
    with_all_drive_terms,
)
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.pruning import PrunedModel, prune, prune_by_likelihood
from pytest_twin.diagnosis.search.scored_model import SelectedModel
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict import UNSEEN, JointError, Verdict, verdict
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.diagnosis.window_length import model_follows_recordings
from pytest_twin.effects.contact_geoms import ContactGeoms
from pytest_twin.errors import SimulationError
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Scales
from pytest_twin.estimation.score import Likelihood, laplace_log_likelihood, log_likelihood
from pytest_twin.realization import Realization
from pytest_twin.realization.inputs import joint_inputs
from pytest_twin.trial import Trial

# Greatest unexplained share of the squared mismatch of a search that explains most of it.
_MAX_REMAINING_SHARE = 0.1
# Least unexplained share for which effects found in windows are refitted to whole recordings.
_MIN_REMAINING_SHARE = 0.01
# Confidence of an effect whose alternatives were not compared.
_UNCOMPARED_CONFIDENCE = 0.5


@dataclass(frozen=True, slots=True)
class SearchResult:
    """The result of one search.

    Attributes:
        prepared, trials: the problem, and its recordings.
        selected, pruned, explanation: the chosen effects, those that pruning keeps, the findings.
        before, after: (samples, signals) residuals over all segments.
        errors: joint -> prediction errors on held-out recordings, or on all without any.
        likelihood: that its parameters maximize.
        whole: problem of whole recordings, which orders the findings of windows.
    """

    prepared: PreparedProblem
    trials: TrialSet
    selected: SelectedModel
    pruned: PrunedModel
    explanation: Explanation
    before: FloatArray
    after: FloatArray
    errors: Mapping[str, JointError]
    verdict: Verdict
    likelihood: Likelihood = log_likelihood
    whole: Problem | None = None

    @property
    def worst_fraction(self) -> float:
        """Greatest unexplained share of the squared mismatch of a joint, 0 to 1."""
        return max((e.fraction for e in self.errors.values() if not e.is_explained), default=0.0)

    @property
    def worst_joint(self) -> int:
        """Column of the joint whose residual is the largest multiple of its noise floor."""
        joints = self.prepared.problem.joints
        levels = {j: e.after / e.floor for j, e in self.errors.items()}
        return joints.index(max(levels, key=lambda joint: levels[joint]))

    @property
    def has_stick_slip(self) -> bool:
        """Whether a friction effect at the worst joint leaves a large residual there."""
        joint = self.worst_joint
        error = self.errors[self.prepared.problem.joints[joint]]
        has_friction = any(
            t.joint == joint and t.law.family == "friction"
            for t in self.explanation.hypothesis.terms
        )
        return has_friction and error.after > VERDICT.left_floors * error.floor

    @property
    def has_diverged(self) -> bool:
        """Whether whole recordings were simulated and are not explained."""
        whole = not all(s.starts_in_motion for s in self.prepared.problem.simulator.segments)
        return whole and self.verdict in ("improved", "unexplained")

    @property
    def departs_from_recordings(self) -> bool:
        """Whether windows were simulated, are not explained, and are so long that the nominal
        model departs from the recorded motion.
        """
        problem = self.prepared.problem
        starts_in_motion = all(s.starts_in_motion for s in problem.simulator.segments)
        lost = self.verdict in ("improved", "unexplained")
        return starts_in_motion and lost and not model_follows_recordings(problem, self.before)

    def with_floor_of(self, other: SearchResult) -> SearchResult:
        """The same result with the noise floor of another one, which its search may have lowered.

        Args:
            other: a result of the same problem.
        """
        errors = joint_errors(other.prepared, self.before, self.after)
        return replace(
            self,
            prepared=other.prepared,
            errors=errors,
            verdict=verdict(errors, self.explanation.findings),
        )

    def explains_more_than(self, other: SearchResult) -> bool:
        """Whether this result explains most of the mismatch and the other does not."""
        if not self.explanation.findings:
            return False
        return (
            self.verdict == "explained"
            or self.worst_fraction <= _MAX_REMAINING_SHARE < other.worst_fraction
        )

    def may_improve(self, other: SearchResult) -> bool:
        """Whether both results explain most of the mismatch, and this one may improve the other:
        the other leaves some residual, or more than this one with other effects.
        """
        mine, others = ({*s.explanation.hypothesis.terms} for s in (self, other))
        if (
            not (mine and others)
            or max(self.worst_fraction, other.worst_fraction) > _MAX_REMAINING_SHARE
        ):
            return False
        return other.worst_fraction > _MIN_REMAINING_SHARE or (
            mine != others and self.worst_fraction < other.worst_fraction
        )

    def scores_better_than(self, other: SearchResult) -> bool:
        """Whether the findings of this result have the higher penalized likelihood and the smaller
        residual; both results are of one problem.
        """
        return (
            self._evidence(other, log_likelihood) > 0.0
            and self.worst_fraction < other.worst_fraction
        )

    def tracks_better_than(self, other: SearchResult) -> bool:
        """The same by absolute deviations, for whole recordings of stick-slip motion."""
        return self._evidence(other, laplace_log_likelihood) > 0.0

    def _evidence(self, other: SearchResult, likelihood: Likelihood) -> float:
        comparison = ModelComparison(self.prepared.problem)
        mine, others = (
            comparison.score_without_fit(s.explanation.hypothesis) for s in (self, other)
        )
        comparison.score_models([mine], others, likelihood=likelihood)
        return mine.evidence


def search(
    prepared: PreparedProblem,
    trials: TrialSet,
    selection: EffectSelection,
    start: Hypothesis = EMPTY,
) -> SearchResult:
    """Search for effects, from the nominal model or from a given hypothesis."""
    return conclude(prepared, trials, selection.diagnosis_run, selection.run(start))


def conclude(
    prepared: PreparedProblem, trials: TrialSet, run: Run, selected: SelectedModel
) -> SearchResult:
    """Prune and test the chosen effects; search on first if they lower the noise floor.

    Pruning uses the reserved time once the time of the search is over.
    """
    state = prepared, selected
    if not run.is_over:
        search_on = partial(_search_with_lower_floor, *state, run)
        state = run.attempt("the search with a lower noise floor", search_on, state)
    prepared, selected = state
    problem, comparison = prepared.problem, ModelComparison(prepared.problem, run)
    with run.budget.reserved():
        _weigh_untested(run, selected)
        best = selected.best
        if best.fitted.jacobian.shape[2] != best.hypothesis.theta.size:
            selected.best = comparison.score_without_fit(best.hypothesis, slopes=True)
        pruned = prune(problem, selected, single_step=run.budget.is_out_of_time)
        if not run.budget.is_out_of_time:
            selected, pruned = replace_closest_known(problem, comparison, selected, pruned)
        for note in pruned.notes:
            run.step(
                problem,
                "pruning",
                "rejected",
                note,
                best=ScoredHypothesis(pruned.fitted.hypothesis),
            )
        return build_result(prepared, trials, selected, pruned)


def _weigh_untested(run: Run, selected: SelectedModel) -> None:
    """Halve the confidence of effects that were not compared with alternatives in time."""
    for term in selected.best.hypothesis.terms if run.is_over else ():
        if term not in selected.confidence:
            selected.confidence[term] = _UNCOMPARED_CONFIDENCE
            selected.not_simulated |= {term}
            run.skip(f"the comparison of {term.effect} with its alternatives")


def _search_with_lower_floor(
    prepared: PreparedProblem, selected: SelectedModel, run: Run
) -> tuple[PreparedProblem, SelectedModel]:
    """Repeat the search from its own result while that lowers the noise floor."""
    while True:
        best = selected.best.hypothesis
        lower = prepared.with_lower_floor(best) if best.terms else None
        if lower is None:
            return prepared, selected
        prepared, selected = lower, EffectSelection(lower.problem, run).run(best)


def confirm_effects(
    prepared: PreparedProblem, trials: TrialSet, other: SearchResult, run: Run
) -> SearchResult | None:
    """Refit the effects of another search to this problem; None if they do not explain it."""
    start = other.explanation.hypothesis
    if not start.terms:
        return None
    selection = EffectSelection(prepared.problem, run)
    comparison = selection.comparison
    fitted = comparison.fit_to_convergence(comparison.score_without_fit(start))
    before, after = (residuals_everywhere(prepared.problem, h) for h in (EMPTY, fitted.hypothesis))
    if not all(e.is_explained for e in joint_errors(prepared, before, after).values()):
        return None
    found = conclude(prepared, trials, run, selection.refine(fitted))
    return found if found.verdict == "explained" else None


def refit_whole_motions(found: SearchResult, other: SearchResult) -> SearchResult:
    """Refit the effects that ``other`` found in windows to the whole recordings of ``found``.

    No effect is added or dropped. In stick-slip motion whole simulations depart from the recording
    at the end of each slide, and these errors hide the influence of a single effect. Effects that
    both searches found start from the values of either.
    """
    problem, named = found.prepared.problem, other.selected
    comparison = ModelComparison(problem)
    start, mine = named.best.hypothesis, found.selected.best.hypothesis
    both = start.with_values_of(mine)
    steps = initial_covariance_root(named.best.fitted, other.prepared.problem.signal_floor)
    end = _fit_by_evolution(comparison, [start, both], steps)
    best = comparison.score_without_fit(end, slopes=True)
    selected = SelectedModel(
        best, comparison.nominal, named.confidence, named.alternatives,
        sets=named.sets, nearby_models=named.nearby_models,
        candidate_count=comparison.candidate_count,
    )  # fmt: skip
    return build_result(
        found.prepared,
        found.trials,
        selected,
        prune_by_likelihood(comparison, best),
        laplace_log_likelihood,
    )


def refit_with_full_drive(
    found: SearchResult, other: SearchResult, longer: PreparedProblem
) -> SearchResult:
    """Fit the common effects of two searches and all drive effects of the worst joint together.

    The fit starts in windows, continues in longer windows and ends with whole recordings. A fit of
    whole recordings that starts from short windows ends in one of many local minima.

    Args:
        other: result in windows.
        longer: the problem in longer windows.
    """
    joint, short, whole = (
        found.worst_joint,
        ModelComparison(other.prepared.problem),
        found.prepared.problem,
    )
    mine, others = (s.explanation.hypothesis for s in (found, other))
    both = others.without(*(t for t in others.terms if t not in mine.terms))
    for term in mine.terms:
        if term.joint != joint and term not in both.terms:
            both = both.with_term_of(mine, term)
    start = fit_all_terms(short, with_all_drive_terms(short.problem, both, joint))
    steps = initial_covariance_root(start.fitted, short.problem.signal_floor)
    end, middle, last = start.hypothesis, ModelComparison(longer.problem), ModelComparison(whole)
    for comparison in (middle, last):
        end = _fit_by_evolution(comparison, [end], steps)
    best = last.score_without_fit(end, slopes=True)
    pruned = prune_by_likelihood(last, best)
    named = weigh_by_removal(last, best, pruned.removal_evidence)
    for term in both.terms:
        # The search in windows has compared these effects with alternatives.
        if term in other.selected.confidence:
            named.confidence[term] = other.selected.confidence[term]
            named.alternatives[term] = other.selected.alternatives.get(term, [])
            if term in other.selected.sets:
                named.sets[term] = other.selected.sets[term]
    return build_result(found.prepared, found.trials, named, pruned, laplace_log_likelihood)


def _fit_by_evolution(
    comparison: ModelComparison, starts: Sequence[Hypothesis], steps: FloatArray
) -> Hypothesis:
    """Result of an evolution from some starts; the integration error is that of the first."""
    problem = comparison.problem.at(starts[0])
    return fit_by_evolution(problem, starts, comparison.weights(comparison.nominal), steps)


def build_result(
    prepared: PreparedProblem,
    trials: TrialSet,
    selected: SelectedModel,
    pruned: PrunedModel,
    likelihood: Likelihood = log_likelihood,
) -> SearchResult:
    """The result of the effects that pruning keeps: findings, residuals, errors and verdict."""
    problem = prepared.problem
    explanation = build_explanation(prepared, selected, pruned, (*trials.fit, *trials.held_out))
    before, after = (residuals_everywhere(problem, h) for h in (EMPTY, explanation.hypothesis))
    errors = joint_errors(prepared, before, after)
    outcome = verdict(errors, explanation.findings)
    return SearchResult(
        prepared, trials, selected, pruned, explanation, before, after, errors, outcome, likelihood
    )


def build_problem(
    setup: ModelSetup,
    trials: TrialSet,
    notes: list[str],
    window: float | None = None,
    contact: ContactGeoms | None = None,
    scales: Scales | None = None,
) -> tuple[PreparedProblem, TrialSet]:
    """Build the problem; recordings on which the nominal model diverges are left out.

    Args:
        setup: the model and its simulation settings.
        notes: receives a line for each recording that is left out.
        window, contact, scales: as :func:`~pytest_twin.diagnosis.prepare.prepare` has them.

    Raises:
        SimulationError: it diverges on all of them.
    """
    while True:
        everything = (*trials.fit, *trials.held_out)
        prepared = setup.prepare(trials.fit, trials.held_out, window, contact, scales)
        problem = prepared.problem
        predicted = problem.predict([EMPTY], problem.all_segments)[0]
        diverged = {
            prepared.segment_trial[s]
            for s, p in enumerate(predicted)
            if not np.isfinite(p.position).all()
        }
        if not diverged:
            idle = _joints_without_setpoint(setup.realization, problem)
            notes += _notes_on_assumptions(prepared, everything, setup.outside_mjcf, idle)
            # Under this noise floor no residual counts, and no fit depends on the joint.
            unseen = np.isin(problem.joints, [*trials.unseen, *idle])
            floor = np.where(unseen, UNSEEN, problem.floor)
            return replace(prepared, problem=replace(problem, floor=floor)), trials
        for i in sorted(diverged):
            notes.append(f"left out: {everything[i].path}: the simulation of the model diverges")
        fit = tuple(t for i, t in enumerate(everything[: len(trials.fit)]) if i not in diverged)
        aside = tuple(
            t for i, t in enumerate(trials.held_out, start=len(trials.fit)) if i not in diverged
        )
        if not fit:
            raise SimulationError(
                "the simulation of the model diverges under the recorded commands",
                path=everything[min(diverged)].path,
                expected="a model that can be simulated through at least one recording; check its "
                "gains, inertias and timestep",
            )
        trials = replace(trials, fit=fit, held_out=aside)


def _notes_on_assumptions(
    prepared: PreparedProblem,
    trials: Sequence[Trial],
    outside_mjcf: Sequence[AppliedEffect],
    idle: Sequence[str],
) -> list[str]:
    """Assumptions that no recording confirms, a line each."""
    problem = prepared.problem
    notes = [
        f"{e.effect} of joint {e.joint!r} is not applied: no recording contains this joint"
        for e in outside_mjcf
        if not e.is_in_mjcf and e.joint not in (None, *problem.joints)
    ]
    owners = prepared.segment_trial
    for i, trial in enumerate(trials):
        first = problem.simulator.segments[owners.index(i)]
        if first.start > 0.0 and first.command_time[0] > 0.0:
            notes.append(
                f"{trial.path.name}: its first {first.start:.3g} s are not used, because the "
                "command before the first recorded one is unknown"
            )
        if first.velocity is None and not first.starts_in_motion and first.initial_velocity.any():
            notes.append(
                f"{trial.path.name}: the robot moves at the start and no velocity is recorded; the "
                "initial velocity is estimated from the positions"
            )
    notes += [
        f"joint {joint!r}: no recording contains commands of its servo; it is assumed to hold its "
        "initial position, and its error is not evaluated"
        for joint in idle
    ]
    return notes + notes_on_low_weights(problem)


def notes_on_low_weights(problem: Problem) -> list[str]:
    """A line for each joint at which some windows have less than half the weight of others."""
    if not problem.position_weights:
        return []
    weights = np.array(list(problem.position_weights.values()))
    few = (weights < 0.5 * weights.max(axis=0)).sum(axis=0)
    return [
        f"joint {joint!r}: {few[j]} of {len(weights)} windows have less than half the weight, in "
        "the errors too: dry friction sticks or reverses there, and its presliding is unknown"
        for j, joint in enumerate(problem.joints)
        if few[j]
    ]


def _joints_without_setpoint(realization: Realization, problem: Problem) -> list[str]:
    """Joints with a position servo whose setpoint is not recorded."""
    servo = problem.simulator.layout.servo
    return [
        joint
        for joint, mode in zip(problem.joints, servo, strict=True)
        if mode == "none"
        and any(i.mode == "position" for i in joint_inputs(realization.model, joint))
    ]


def residuals_everywhere(problem: Problem, hypothesis: Hypothesis) -> FloatArray:
    """(samples, signals) residuals of all segments, corrected for the integration error."""
    return problem.at(hypothesis).residuals([hypothesis], problem.all_segments)[0]


def joint_errors(
    prepared: PreparedProblem, before: FloatArray, after: FloatArray
) -> dict[str, JointError]:
    """Joint -> RMS errors on held-out recordings, or on all where none is held out.

    Args:
        before, after: (samples, signals) residuals over all segments, without and with effects.
    """
    problem = prepared.problem
    inside = problem.is_in_test
    travel = np.ptp(
        np.concatenate([problem.simulator.segments[s].position for s in problem.tested_segments]),
        axis=0,
    )
    found = {}
    for j, joint in enumerate(problem.joints):
        if problem.floor[j] >= UNSEEN:
            continue
        rms = [float(np.sqrt(np.mean(r[inside, j] ** 2))) for r in (before, after)]
        floor, unit = float(problem.floor[j]), joint_unit(problem, j)
        found[joint] = JointError(rms[0], rms[1], floor, unit, float(travel[j]))
    return found
