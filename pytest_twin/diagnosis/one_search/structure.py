"""The search over the recordings of a diagnosis, with the inputs and result of the present ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.diagnosis.conclusion import ChosenModel
from pytest_twin.diagnosis.friction_constraint import (
    FRICTION_CREEP_NOTE,
    build_problem_with_better_constraint,
)
from pytest_twin.diagnosis.integrator_detection import adopt_simulation_step, describe_integrator
from pytest_twin.diagnosis.intervals import parameter_uncertainty
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.one_search.accept import Acceptance
from pytest_twin.diagnosis.one_search.model import Model
from pytest_twin.diagnosis.one_search.physics import SimulatedPhysics
from pytest_twin.diagnosis.one_search.posterior import Posterior, posterior
from pytest_twin.diagnosis.one_search.report_rules import rejections
from pytest_twin.diagnosis.one_search.search import Search
from pytest_twin.diagnosis.one_search.search import SearchResult as PooledSearch
from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run, ScoredHypothesis
from pytest_twin.diagnosis.search.noise_levels import label
from pytest_twin.diagnosis.search.pruning import PrunedModel, refit_without_each
from pytest_twin.diagnosis.search.scored_model import ScoredModel, SelectedModel
from pytest_twin.diagnosis.search_result import SearchResult, build_result
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.unit_check import drop_other_units
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.hypothesis import EMPTY
from pytest_twin.estimation.least_squares import FittedModel, weighted_cost
from pytest_twin.realization import Realization
from pytest_twin.recording_options import CommandBetween

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
        realization: the nominal model.
        trials: the fit recordings; the validation recordings are in the place of held-out ones.
        inherited, threads, run, progress: as of
            :func:`~pytest_twin.diagnosis.diagnose.find_structure`.
        possible: possible interpolations of the commands; not used yet.

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
    found = search_recordings(prepared, trials, run, notes)
    if setup.has_friction_creep:
        notes.append(FRICTION_CREEP_NOTE)
    if setup.substeps:
        notes.append(describe_integrator(found.prepared))
    return ChosenModel(setup, found, None, (*notes, *found.explanation.notes))


def search_recordings(
    prepared: PreparedProblem, trials: TrialSet, run: Run, notes: list[str]
) -> SearchResult:
    """The result of one search, with the effects that the report rules leave.

    Args:
        prepared, trials: the problem, and its recordings.
        run: the running diagnosis.
        notes: receives a line where only one recording was searched.
    """
    problem = prepared.problem
    run.begin("whole recordings", problem)
    with run.budget.reserved():
        physics = SimulatedPhysics(problem)
        search = Search(physics, listener=_tracer(problem, run), check=lambda: _check(run))
    with run.budget.searching():
        found = search.run()
    if not found.is_complete:
        run.skip("the search for further effects")
    if found.comparison.has_one_recording:
        notes.append(_ONE_RECORDING_NOTE)
    with run.budget.reserved():
        return _conclude(prepared, trials, physics, found)


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


def _conclude(
    prepared: PreparedProblem, trials: TrialSet, physics: SimulatedPhysics, found: PooledSearch
) -> SearchResult:
    """Findings of a search: confidences from its pool, names by the report rules."""
    problem, notes = prepared.problem, list[str]()
    shares = posterior(found, lambda h: not physics.refusals(h))
    model = found.incumbent
    while model.hypothesis.terms:
        fitted = _fitted(problem, model)
        here = problem.at(model.hypothesis)
        refitted, *_ = refit_without_each(here, fitted)
        without = {
            t: np.mean(f.residual**2, axis=0)
            for t, f in zip(model.hypothesis.terms, refitted, strict=True)
        }
        rejected = rejections(
            model, found.nominal, without, parameter_uncertainty(here, fitted),
            physics.floor, physics.refusals(model.hypothesis), len(physics.joints),
        )  # fmt: skip
        if not rejected:
            reduced = [f.hypothesis for f in refitted]
            return _result(prepared, trials, found, shares, model,
                           PrunedModel(fitted, reduced, notes))  # fmt: skip
        notes += [f"rejected: {label(problem, t)}: {why}" for t, why in rejected.items()]
        rest = model.hypothesis.without(*rejected)
        (residual,) = physics.simulate([rest], rest)
        hypothesis, residual, jacobian = physics.fit(rest, residual, 4)
        model = Model.of(
            found.comparison, hypothesis, residual, physics.size(hypothesis), "report", hypothesis
        ).with_jacobian(found.comparison, jacobian)
    pruned = PrunedModel(_fitted(problem, model), [], notes)
    return _result(prepared, trials, found, shares, model, pruned)


def _fitted(problem: Problem, model: Model) -> FittedModel:
    weights = problem.weights(model.mean_square)
    assert model.jacobian is not None
    return FittedModel(
        model.hypothesis, model.residual, model.jacobian, weighted_cost(model.residual, weights)
    )


def _result(
    prepared: PreparedProblem,
    trials: TrialSet,
    found: PooledSearch,
    shares: Posterior,
    model: Model,
    pruned: PrunedModel,
) -> SearchResult:
    problem = prepared.problem
    none = model.residual[:0]
    selected = SelectedModel(
        ScoredModel(pruned.fitted, none, problem.at(model.hypothesis)),
        ScoredModel(_fitted(problem, found.nominal), none, problem.at(EMPTY)),
        confidence=shares.confidence,
        sets=shares.alternatives,
        nearby_models=shares.nearby,
        candidate_count=found.comparison.candidates,
    )
    return build_result(prepared, trials, selected, pruned)
