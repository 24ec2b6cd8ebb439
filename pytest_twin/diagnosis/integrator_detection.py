"""Detection of recordings that a simulation made, from its discretization error.

Predictions are corrected for the discretization error, because a robot has none. Recordings of a
simulation contain it. With the correction, even the exact model would have a residual, and wrong
damping and inertia would be found. If the error is above the noise, predictions with and without
the correction are compared. Recordings come from a simulation if only noise remains without it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.coarse_step import integration_errors
from pytest_twin.diagnosis.first_order.beam_search import candidates
from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.first_order.sensitivities import linearize, starting_grid
from pytest_twin.diagnosis.friction_constraint import has_dry_friction, with_other_constraint
from pytest_twin.diagnosis.integrator_settings import INTEGRATOR
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.prepare import (
    NOISE,
    STEP,
    PreparedProblem,
    discretization_rms,
)
from pytest_twin.diagnosis.prepare_settings import PREPARE
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search.noise_levels import in_noise_floors
from pytest_twin.diagnosis.search.scored_model import ScoredModel
from pytest_twin.diagnosis.search_result import SearchResult, build_problem
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict import UNSEEN
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.effects.segment import Predicted
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term

SUBSTEPS = (1, 2, 4, 5)
"""Substeps for each step of the model that are compared. With more of them the discretization error
is below the noise floor."""
# Smallest noise and travel of a joint, rad or m.
_SMALLEST = 1e-9


def adopt_simulation_step(
    setup: ModelSetup, prepared: PreparedProblem, trials: TrialSet, run: Run
) -> tuple[ModelSetup, PreparedProblem, TrialSet]:
    """The problem with the substeps of a simulation, if the nominal model then explains all.

    If the metadata of all recordings have ``source: simulation``, it is that of a simulation in any
    case, with the model's own step where the nominal model does not tell. If they have ``source:
    robot``, no simulation is searched for.

    Args:
        setup: the model with its simulation settings.
        prepared, trials: the problem for recordings of a robot, and its trials.

    Returns:
        Settings, problem and trials; unchanged if no simulation is declared or detected.
    """
    sources = {t.source for t in (*trials.fit, *trials.held_out)}
    if sources == {"robot"}:
        return replace(setup, is_of_robot=True), prepared, trials
    substeps = _substeps_by_nominal_model(prepared)
    if not substeps and sources != {"simulation"}:
        return setup, prepared, trials
    run.budget.add(prepared.problem)
    setup = replace(setup, substeps=substeps or 1)
    return setup, *build_problem(setup, trials, [])


def detect_integrator(found: SearchResult, setup: ModelSetup) -> ModelSetup | None:
    """Settings of the simulation that may have made the recordings; None if none is detected.

    Numbers of substeps, and both friction constraints if there is dry friction, are compared to
    first order around the findings. For each, parameters of the findings and further nearly linear
    effects are fitted. Models with elastic transmissions are not compared, because this package
    integrates their motors with its own method.

    Args:
        found: result with the correction of the discretization error.
        setup: the model with its simulation settings.
    """
    problem, best = found.prepared.problem, found.selected.best
    noise = _noise(found.prepared)
    if setup.is_of_robot or any(t.law.is_elastic_transmission for t in best.hypothesis.terms):
        return None
    if found.verdict == "no_mismatch":
        return None
    problem = problem.at(best.hypothesis)
    if not _is_measured(problem):
        return None
    if (discretization_rms(problem) < VERDICT.identifiable * noise).all():
        return None
    if not _error_stays_small(problem):
        return None
    linearized = _LinearizedFit(problem, best)
    before = linearized.remaining(problem, noise)
    is_visible = bool((before > VERDICT.identifiable**2).any())
    remaining_by_choice = {}
    for has_friction_creep, simulated in _with_each_constraint(
        problem, best.hypothesis, setup
    ).items():
        for k in SUBSTEPS:
            corrected = _with_corrected_share(simulated, 1.0 - 1.0 / k)
            above = np.maximum(linearized.remaining(corrected, noise) - 1.0, 0.0).sum()
            remaining_by_choice[has_friction_creep, k] = float(above)
    has_friction_creep, substeps = min(
        remaining_by_choice, key=lambda choice: remaining_by_choice[choice]
    )
    limit = INTEGRATOR.left_linearized * float(np.maximum(before - 1.0, 0.0).sum())
    if is_visible and remaining_by_choice[has_friction_creep, substeps] <= limit:
        return replace(setup, has_friction_creep=has_friction_creep, substeps=substeps)
    # A linearization around a wrong effect is not conclusive: the discretization error may still be
    # the cause of the residual.
    findings = found.explanation.findings
    is_possible = findings and integration_errors(problem, found.errors, 1.0)
    return replace(setup, substeps=1) if is_possible else None


def simulation_explains_more(simulation: SearchResult, found: SearchResult) -> bool:
    """Whether a result for recordings of a simulation is better than that for a robot.

    It must explain the recordings, have no more effects, and have a far smaller residual.

    Args:
        simulation: result without the correction of the discretization error.
        found: result with the correction.
    """
    if simulation.verdict not in ("explained", "no_mismatch"):
        return False
    of_simulation, of_robot = (s.explanation.hypothesis for s in (simulation, found))
    if of_simulation.more_terms(of_robot) > 0:
        # A further effect would explain the recordings as well without an integration error.
        return False
    less = [e.after / max(found.errors[j].after, 1e-12) for j, e in simulation.errors.items()]
    return max(less) <= 1.0 and min(less) <= INTEGRATOR.left


def describe_integrator(prepared: PreparedProblem) -> str:
    """A note that the recordings come from a simulation with a certain time step."""
    step = 1e3 * prepared.problem.simulator.timestep
    return (
        f"the recordings come from a simulation with a time step of {step:g} ms: predictions keep "
        "the integration error of that step (for recordings of a robot it is removed)"
    )


def _substeps_by_nominal_model(prepared: PreparedProblem) -> int:
    """Number of substeps with which only noise remains under the nominal model.

    It is 0 if more than noise remains with every number, or if the correction makes no difference.
    """
    problem, noise = prepared.problem.at(EMPTY), _noise(prepared)
    if not _is_measured(problem):
        return 0
    before = _squares(problem, EMPTY, noise)
    left = {
        k: _squares(_with_corrected_share(problem, 1.0 - 1.0 / k), EMPTY, noise) for k in SUBSTEPS
    }
    best = min(left, key=lambda k: float(left[k].max()))
    only_noise = bool((left[best] < VERDICT.identifiable**2).all())
    above = [float(np.maximum(x - 1.0, 0.0).sum()) for x in (left[best], before)]
    is_visible = bool((before > VERDICT.identifiable**2).any())
    return best if only_noise and is_visible and above[0] <= INTEGRATOR.left * above[1] else 0


def _noise(prepared: PreparedProblem) -> FloatArray:
    """(joints,) standard deviation against which the discretization error is compared, rad or m.

    It is the sensor noise with a small share of the error itself. A joint with a stuck encoder has
    its noise floor.
    """
    floor, parts = prepared.problem.floor, prepared.floor_parts
    noise = np.hypot(parts[NOISE], PREPARE.step_of_simulation * parts[STEP])
    known: FloatArray = np.where(floor >= UNSEEN, floor, np.maximum(noise, _SMALLEST))
    return known


def _error_stays_small(problem: Problem) -> bool:
    """Whether the discretization error is small against the motion.

    If it grows (an oscillating servo, a falling arm), it is not of first order in whole recordings.
    """
    travel = np.array([np.ptp(s.position, axis=0) for s in problem.simulator.segments])
    size = INTEGRATOR.first_order_share * np.sqrt(np.mean(travel**2, axis=0))
    return bool((discretization_rms(problem) <= np.maximum(size, _SMALLEST)).all())


def _is_measured(problem: Problem) -> bool:
    """Whether the discretization error of every segment is known."""
    known = len(problem.discretization_error) == len(problem.simulator.segments)
    return problem.refined is not None and known


def _with_corrected_share(problem: Problem, share: float) -> Problem:
    """The same problem with a correction by only a share of the discretization error."""
    part = {
        i: Predicted(share * e.position, share * e.velocity, share * e.effort)
        for i, e in problem.discretization_error.items()
    }
    return replace(problem, refined=None, discretization_error=part)


def _with_each_constraint(
    problem: Problem, hypothesis: Hypothesis, setup: ModelSetup
) -> dict[bool, Problem]:
    """Whether joints creep under dry friction -> the problem with that friction constraint.

    Without dry friction there is only one.
    """
    by_constraint = {setup.has_friction_creep: problem}
    if has_dry_friction(problem, hypothesis):
        by_constraint[not setup.has_friction_creep] = with_other_constraint(problem)
    return by_constraint


def _squares(problem: Problem, hypothesis: Hypothesis, noise: FloatArray) -> FloatArray:
    """(joints,) mean squared position residuals on the fit segments, in noise variances."""
    (left,) = problem.residuals([hypothesis], problem.fit)
    return in_noise_floors(left[:, : len(noise)], noise) ** 2


class _LinearizedFit:
    """Sensitivities around a fit: to its parameters, and to nearly linear effects that it lacks."""

    def __init__(self, problem: Problem, best: ScoredModel) -> None:
        self.hypothesis = best.hypothesis
        self.bins = bins(problem, problem.fit)
        columns = []
        if best.fitted.jacobian.shape[2]:
            columns.append(self.bins.mean(best.fitted.jacobian))
        linear = linearize(problem, problem.fit, best.hypothesis)
        if linear is not None:
            by_effect: dict[str, list[Term]] = {}
            for term in candidates(problem):
                if term.law.nearly_linear and term not in best.hypothesis.terms:
                    by_effect.setdefault(term.effect, []).append(term)
            for terms in by_effect.values():
                found = linear.at_sizes(terms, starting_grid(terms[0])[:1])
                columns += [response.change for response in found]
        signals = (len(self.bins.counts), len(problem.signal_floor), 0)
        self.columns = np.concatenate([np.zeros(signals), *columns], axis=2)

    def remaining(self, problem: Problem, noise: FloatArray) -> FloatArray:
        """(joints,) mean squared position residuals after a linear fit, in noise variances.

        Residuals are means over bins.
        """
        joints = len(noise)
        bin_noise = noise / np.sqrt(self.bins.counts.mean())
        (residual,) = problem.residuals([self.hypothesis], problem.fit)
        binned = self.bins.mean(residual)[:, :joints] / bin_noise
        design = (self.columns[:, :joints] / bin_noise[:, None]).reshape(binned.size, -1)
        # Columns of very different size would make the least-squares problem ill-conditioned.
        design = design / np.maximum(np.linalg.norm(design, axis=0), 1e-30)
        fitted = design @ np.linalg.lstsq(design, binned.ravel(), rcond=None)[0]
        return in_noise_floors(binned - fitted.reshape(binned.shape), np.ones(joints)) ** 2
