"""Settings of the simulation that the nominal model decides before the search.

Predictions are corrected for the discretization error, because a robot has none. Recordings of a
simulation contain it. With the correction, even the exact model would have a residual, and wrong
damping and inertia would be found. Where the nominal model explains all but this error, the step of
that simulation is adopted.

A real joint at rest under its friction does not move. With MuJoCo's default friction constraint it
creeps, and so it does in recordings that MuJoCo made. Where the nominal model is nearly right and
has dry friction, the constraint that explains more is adopted. Later both settings are proposals of
the search (:meth:`~pytest_twin.diagnosis.search.physics.Physics.other_settings`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.build_problem import build_problem, residuals_everywhere
from pytest_twin.diagnosis.integrator_settings import INTEGRATOR
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.noise_levels import excess, in_noise_floors
from pytest_twin.diagnosis.prepare import NOISE, STEP, PreparedProblem
from pytest_twin.diagnosis.prepare_settings import PREPARE
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict import UNSEEN
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.effects.segment import Predicted
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis

FRICTION_CREEP_NOTE = (
    "dry friction creeps under load in these recordings, as in MuJoCo's default friction "
    "constraint; with friction that holds at rest the residual is larger"
)
SUBSTEPS = (1, 2, 4, 5)
"""Substeps for each step of the model that are compared. With more of them the discretization error
is below the noise floor."""
# Smallest noise of a joint, rad or m.
_SMALLEST = 1e-9


def build_problem_with_better_constraint(
    setup: ModelSetup, trials: TrialSet, notes: list[str]
) -> tuple[ModelSetup, PreparedProblem, TrialSet]:
    """The problem, with the friction constraint that explains the recordings better.

    The constraints are compared only if the nominal model is nearly right.

    Args:
        setup: the model with its simulation settings.
        notes: receives notes for the reader.

    Raises:
        SimulationError: as :func:`~pytest_twin.diagnosis.build_problem.build_problem`.
    """
    prepared, kept = build_problem(setup, trials, notes)
    problem = prepared.problem
    if not has_dry_friction(problem, EMPTY):
        return setup, prepared, kept
    left = residuals_everywhere(problem, EMPTY)
    worst = float(_position_levels(problem, left).max())
    if not VERDICT.identifiable < worst < VERDICT.left_floors:
        return setup, prepared, kept
    changed_setup = replace(setup, has_friction_creep=not setup.has_friction_creep)
    changed, _ = build_problem(changed_setup, kept, [])
    other = residuals_everywhere(changed.problem, EMPTY)
    if other.shape == left.shape and _reduces_residual(problem, other, left, INTEGRATOR.left):
        return changed_setup, changed, kept
    return setup, prepared, kept


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
    above = [excess(x) for x in (left[best], before)]
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


def _squares(problem: Problem, hypothesis: Hypothesis, noise: FloatArray) -> FloatArray:
    """(joints,) mean squared position residuals on the fit segments, in noise variances."""
    (left,) = problem.residuals([hypothesis], problem.fit)
    return in_noise_floors(left[:, : len(noise)], noise) ** 2


def has_dry_friction(problem: Problem, hypothesis: Hypothesis) -> bool:
    """Whether the model or the hypothesis contains dry friction."""
    layout, models = problem.simulator.layout, {s.model for s in problem.simulator.segments}
    own = any(m.dof_frictionloss[layout.dof_index].any() for m in models)
    return own or any(t.dry_level is not None for t in hypothesis.terms)


def _position_levels(problem: Problem, left: FloatArray) -> FloatArray:
    """(joints,) RMS position residual, in noise floors."""
    return in_noise_floors(left[:, : len(problem.joints)], problem.floor)


def _reduces_residual(problem: Problem, left: FloatArray, than: FloatArray, share: float) -> bool:
    """Whether the squared residual above the noise floor is at most ``share`` of that of ``than``.

    Both are summed over joints.
    """
    new, old = (excess(_position_levels(problem, x) ** 2) for x in (left, than))
    return new <= share * old
