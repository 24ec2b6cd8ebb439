"""The search over the recordings of a diagnosis, with the inputs and result of the present ones."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.conclusion import ChosenModel
from pytest_twin.diagnosis.first_answer import hypothesis_of
from pytest_twin.diagnosis.friction_constraint import (
    FRICTION_CREEP_NOTE,
    build_problem_with_better_constraint,
)
from pytest_twin.diagnosis.integrator_detection import adopt_simulation_step, describe_integrator
from pytest_twin.diagnosis.intervals import parameter_uncertainty
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.one_search.model import Acceptance, Model
from pytest_twin.diagnosis.one_search.physics import SimulatedPhysics
from pytest_twin.diagnosis.one_search.posterior import Posterior, best_named, posterior
from pytest_twin.diagnosis.one_search.report_rules import rejections
from pytest_twin.diagnosis.one_search.search import Search
from pytest_twin.diagnosis.one_search.search import SearchResult as PooledSearch
from pytest_twin.diagnosis.one_search.settings import SETTINGS
from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.diagnosis.patched.native import mjcf_expresses
from pytest_twin.diagnosis.prepare import NOISE, PreparedProblem
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run, ScoredHypothesis
from pytest_twin.diagnosis.search.noise_levels import label
from pytest_twin.diagnosis.search.pruning import PrunedModel, refit_without_each
from pytest_twin.diagnosis.search.scored_model import ScoredModel, SelectedModel
from pytest_twin.diagnosis.search_result import (
    SearchResult,
    build_problem,
    build_result,
    residuals_everywhere,
)
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.unit_check import drop_other_units
from pytest_twin.diagnosis.window_length import model_follows_recordings, typical_window_length
from pytest_twin.diagnosis.window_settings import WINDOWS
from pytest_twin.diagnosis.windows import WINDOW
from pytest_twin.errors import RecordingError
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis
from pytest_twin.estimation.least_squares import FittedModel, weighted_cost
from pytest_twin.realization import Realization
from pytest_twin.recording_options import CommandBetween

_LAST_ITERATIONS = 8
"""Iterations of the last fit; one that has converged stops earlier."""
_SMALLEST_NOISE = 1e-9
"""Smallest noise of a position, rad or m."""
_LOWER_FLOORS = 2
"""Largest number of searches with a lower noise floor."""
_WINDOWS_NOTE = (
    "all errors are of predictions over windows of {:.2g} s that start from measured states: over "
    "whole recordings small errors of this motion grow"
)
_ONE_RECORDING_NOTE = (
    "effects were accepted on parts of one recording, because there is no second one to predict; "
    "no confidence is above 90 %"
)


def find_structure(
    realization: Realization,
    trials: TrialSet,
    *,
    inherited: PatchedModel | None = None,
    threads: int = 0,
    run: Run | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
    possible: Sequence[CommandBetween] = (),
) -> ChosenModel:
    """Choose effects and fit them, without the test recordings.

    Validation recordings are fitted too: effects are accepted by cross-validation over all.

    Args:
        trials: the fit recordings; the validation recordings are in the place of held-out ones.
        inherited, threads, run, progress: as of
            :func:`~pytest_twin.diagnosis.diagnose.find_structure`.
        possible: possible interpolations of the commands between their stamps.

    Raises:
        RecordingError, SpecError: as of :func:`~pytest_twin.diagnosis.diagnose.diagnose`.
    """
    run = Run() if run is None else run
    notes: list[str] = []
    setup = ModelSetup.of(realization, inherited, threads)
    progress(0.02)
    trials = replace(trials, fit=(*trials.fit, *trials.held_out), held_out=())
    trials = drop_other_units(realization, trials, notes)
    setup, prepared, trials = build_problem_with_better_constraint(setup, trials, notes)
    progress(0.06)
    run.trace.listeners.append(lambda step: progress(0.06 + 0.74 * run.share_done))
    setup, prepared, trials = adopt_simulation_step(setup, prepared, trials, run)
    searched = _search_recordings(SimulatedPhysics(setup, prepared, trials, possible), run)
    physics = searched.physics
    assert isinstance(physics, SimulatedPhysics)
    if not searched.is_complete:
        run.skip("the search for further effects")
    if searched.comparison.has_one_recording:
        notes.append(_ONE_RECORDING_NOTE)
    with run.budget.reserved():
        found = _conclude(physics, searched)
    window = physics.prepared.window
    if window is not None:
        notes.append(_WINDOWS_NOTE.format(window))
        found = replace(found, whole=prepared.problem)
    setup = physics.setup
    if setup.has_friction_creep:
        notes.append(FRICTION_CREEP_NOTE)
    if setup.substeps:
        notes.append(describe_integrator(found.prepared))
    every = (*notes, *found.explanation.notes)
    return ChosenModel(setup, found, window, every, between=physics.between)


def _search_recordings(whole: SimulatedPhysics, run: Run) -> PooledSearch:
    """The search over whole recordings, or over windows of them that the model follows.

    Far from contact, and in short windows, the linearization is valid where it is not over whole
    recordings. Where the found model follows the whole recordings, the search continues there.

    Args:
        whole: the robot with its whole recordings.
    """
    setup, prepared, trials = whole.setup, whole.prepared, whole.trials
    problem = prepared.problem
    start = hypothesis_of(problem, run.first_answer) or EMPTY
    contact = problem.simulator.models.contact
    if contact.world.size:
        with contextlib.suppress(RecordingError):
            away, kept = build_problem(setup, trials, [], window=WINDOW, contact=contact)
            far = SimulatedPhysics(setup, away, kept)
            start = _rescaled(start, problem, away.problem)
            found = _search(far, run, "windows far from contact", start)
            start = _rescaled(found.incumbent.hypothesis, away.problem, problem)
    elif not _follows(problem, EMPTY):
        cut = _followed_windows(setup, prepared, trials)
        stage = f"windows of {cut.prepared.window:.2g} s"
        in_windows = _search(cut, run, stage, _rescaled(start, problem, cut.problem))
        start = _rescaled(in_windows.incumbent.hypothesis, cut.problem, problem)
        physics = in_windows.physics
        assert isinstance(physics, SimulatedPhysics)
        whole = SimulatedPhysics(physics.setup, prepared, trials, whole.possible)
        if start.terms and not _follows(problem, start):
            return in_windows
    found = _search(whole, run, "whole recordings", start)
    for _ in range(_LOWER_FLOORS):
        physics, best = found.physics, found.incumbent.hypothesis
        assert isinstance(physics, SimulatedPhysics)
        lower = physics.prepared.with_lower_floor(best) if best.terms else None
        if lower is None or not found.is_complete:
            break
        lowered = SimulatedPhysics(
            physics.setup, lower, physics.trials, physics.possible, between=physics.between
        )
        found = _search(lowered, run, "whole recordings, lower noise floor", best)
    return _with_time_step(found, run)


def _with_time_step(found: PooledSearch, run: Run) -> PooledSearch:
    """The search with the time step of a simulation that made the recordings, if there is one.

    The noise floor contains the discretization error that a simulation's recordings do not have, so
    that a wrong damping is at the floor too. Time steps are compared by the sensor noise alone.

    Args:
        found: the search with the correction of the discretization error.
        run: the running diagnosis.
    """
    physics, incumbent = found.physics, found.incumbent
    assert isinstance(physics, SimulatedPhysics)
    if not incumbent.hypothesis.terms or not found.is_complete:
        return found
    noise = np.maximum(physics.prepared.floor_parts[NOISE], _SMALLEST_NOISE)
    count = found.comparison.independent[: len(noise)]

    def evidence(residual: FloatArray) -> float:
        level = np.mean(residual[:, : len(noise)] ** 2, axis=0) / noise**2
        return float(-0.5 * np.sum(count * np.log(np.maximum(level, 1.0))))

    best, most = None, evidence(incumbent.residual) + SETTINGS.earns
    try:
        with run.budget.searching():
            for other in physics.other_settings(incumbent.hypothesis, is_explained=False):
                assert isinstance(other, SimulatedPhysics)
                if other.setup.substeps == physics.setup.substeps:
                    continue
                start = incumbent.hypothesis
                hypothesis, residual, _ = other.fit(start, incumbent.residual, 3, start)
                if (value := evidence(residual)) > most:
                    best, most = (other, hypothesis), value
    except OutOfTime:
        return found
    if best is None:
        return found
    other, hypothesis = best
    simulation = SimulatedPhysics(
        other.setup, other.prepared, other.trials, other.possible, between=other.between
    )
    return _search(simulation, run, "recordings of a simulation", hypothesis)


def _followed_windows(
    setup: ModelSetup, prepared: PreparedProblem, trials: TrialSet
) -> SimulatedPhysics:
    """The longest windows, each half of the last, in which the model follows the recordings."""
    window = typical_window_length(prepared.problem)
    while True:
        window *= 0.5
        cut, kept = build_problem(setup, trials, [], window=window)
        if _follows(cut.problem, EMPTY) or window <= 2.0 * WINDOWS.shortest:
            return SimulatedPhysics(setup, cut, kept)


def _rescaled(hypothesis: Hypothesis, of: Problem, to: Problem) -> Hypothesis:
    """A hypothesis of one problem in the reference scales of another one."""
    ratios = [
        of.scales.value(p, t.joint) / to.scales.value(p, t.joint)
        for t in hypothesis.terms
        for p in t.parameters
    ]
    return hypothesis.with_theta(np.clip(hypothesis.theta * ratios, *hypothesis.bounds))


def _follows(problem: Problem, hypothesis: Hypothesis) -> bool:
    return model_follows_recordings(problem, residuals_everywhere(problem, hypothesis))


def _search(physics: SimulatedPhysics, run: Run, stage: str, start: Hypothesis) -> PooledSearch:
    """One search, which the limits of the diagnosis may end early."""
    run.begin(stage, physics.problem)
    with run.budget.reserved():
        search = Search(physics, listener=_tracer(physics.problem, run), check=lambda: _check(run))
        # What an earlier search found is the result if no time is left to fit it here.
        earlier = search.simulated(start) if start.terms else None
    with run.budget.searching():
        return search.run(earlier)


def _check(run: Run) -> None:
    if run.is_over:
        raise OutOfTime


def _tracer(problem: Problem, run: Run) -> Callable[[Model, Model, Acceptance], None]:
    def record(model: Model, incumbent: Model, decision: Acceptance) -> None:
        run.step(
            problem, model.origin, "accepted" if decision.is_accepted else "rejected",
            decision.reason,
            ScoredHypothesis(model.hypothesis, model.score),
            ScoredHypothesis(incumbent.hypothesis, incumbent.score),
        )  # fmt: skip

    return record


def _conclude(physics: SimulatedPhysics, found: PooledSearch) -> SearchResult:
    """Findings of a search: confidences from its pool, names by the report rules."""
    problem, notes = physics.problem, list[str]()
    start = found.incumbent.hypothesis
    while True:
        found = replace(found, incumbent=_refit(physics, found, start))
        best = best_named(found, _inexpressible, lambda h: not physics.refusals(h))
        if best is not found.incumbent.hypothesis:
            found = replace(found, incumbent=_refit(physics, found, best))
        model = found.incumbent
        fitted, here = _fitted(problem, model), problem.at(model.hypothesis)
        refitted = refit_without_each(here, fitted)[0] if model.hypothesis.terms else []
        without = {
            t: np.mean(f.residual**2, axis=0)
            for t, f in zip(model.hypothesis.terms, refitted, strict=True)
        }
        rejected = rejections(
            model, found.nominal, without, parameter_uncertainty(here, fitted),
            physics.floor, physics.refusals(model.hypothesis), len(physics.joints),
        )  # fmt: skip
        if not rejected:
            break
        notes += [f"rejected: {label(problem, t)}: {why}" for t, why in rejected.items()]
        start = model.hypothesis.without(*rejected)
    shares = posterior(found, lambda h: not physics.refusals(h))
    reduced = [f.hypothesis for f in refitted]
    return _result(physics, found, shares, model, PrunedModel(fitted, reduced, notes))


def _inexpressible(hypothesis: Hypothesis) -> int:
    """Number of effects that plain MJCF cannot express."""
    return sum(not mjcf_expresses(t.effect) for t in hypothesis.terms)


def _refit(physics: SimulatedPhysics, found: PooledSearch, start: Hypothesis) -> Model:
    """A hypothesis fitted to convergence."""
    (residual,) = physics.simulate([start], start)
    hypothesis, residual, jacobian = physics.fit(start, residual, _LAST_ITERATIONS, start)
    size = physics.size(hypothesis)
    model = Model.of(found.comparison, hypothesis, residual, size, "report", hypothesis)
    return model.with_jacobian(found.comparison, jacobian)


def _fitted(problem: Problem, model: Model) -> FittedModel:
    weights = problem.weights(model.mean_square)
    assert model.jacobian is not None
    return FittedModel(
        model.hypothesis, model.residual, model.jacobian, weighted_cost(model.residual, weights)
    )


def _result(
    physics: SimulatedPhysics,
    found: PooledSearch,
    shares: Posterior,
    model: Model,
    pruned: PrunedModel,
) -> SearchResult:
    problem = physics.problem
    none = model.residual[:0]
    selected = SelectedModel(
        ScoredModel(pruned.fitted, none, problem.at(model.hypothesis)),
        ScoredModel(_fitted(problem, found.nominal), none, problem.at(EMPTY)),
        confidence=shares.confidence,
        sets=shares.alternatives,
        nearby_models=shares.nearby,
        candidate_count=found.comparison.candidates,
    )
    return build_result(physics.prepared, physics.trials, selected, pruned)
