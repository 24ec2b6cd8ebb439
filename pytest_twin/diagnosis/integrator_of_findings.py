"""Detection of recordings that a simulation made, with the findings.

The effects of the findings are fitted again without the correction of the integration error.
Recordings come from a simulation only if every recording is then predicted better, only noise
remains, and no further effect is needed. Example: a time step of 2 ms with a damping of
0.8 N*m*s/rad biases the damping by -5 %, and is detected although its error is 3 % of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.effect_selection import EffectSelection
from pytest_twin.diagnosis.integrator_detection import SUBSTEPS
from pytest_twin.diagnosis.integrator_settings import INTEGRATOR
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.prepare import NOISE
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search_result import (
    SearchResult,
    build_problem,
    conclude,
    residuals_everywhere,
)
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.estimation.hypothesis import Hypothesis, effect_values
from pytest_twin.estimation.score import effective_samples

# Index of the previous step among the neighbouring steps of an effort.
_EARLIER = 1


def refit_with_detected_timestep(
    found: SearchResult, setup: ModelSetup, run: Run
) -> tuple[ModelSetup, SearchResult] | None:
    """The findings without the correction of the integration error, if all recordings agree better.

    Args:
        found: result with the correction of the integration error.
        setup: the model with its simulation settings.

    Returns:
        Settings with the detected substeps, and the result; None if no simulation is detected.
    """
    prepared, start = found.prepared, found.explanation.hypothesis
    problem = prepared.problem
    positions = all(
        s.mode == "position" and not s.starts_in_motion for s in problem.simulator.segments
    )
    known = setup.substeps or setup.is_of_robot
    if known or not start.terms or not positions or found.verdict != "explained":
        return None
    robot = residuals_everywhere(problem, start)[:, : len(problem.joints)]
    noise = prepared.floor_parts[NOISE]
    substeps = _likeliest_substeps(found, robot, noise)
    if not substeps:
        return None
    changed_setup = replace(setup, substeps=substeps)
    for trials in _with_and_without_efforts(found.trials):
        simulated, used = build_problem(changed_setup, trials, [], window=prepared.window)
        selection = EffectSelection(simulated.problem, run)
        comparison = selection.comparison
        fitted = comparison.fit_to_convergence(comparison.score_without_fit(start))
        left = residuals_everywhere(simulated.problem, fitted.hypothesis)[:, : len(problem.joints)]
        if left.shape != robot.shape:
            continue
        known = trials is not found.trials and _has_forces_of_the_step(
            problem, start, simulated.problem, fitted.hypothesis
        )
        # If the efforts show a simulation, the positions must only not contradict it.
        ratio = _log_likelihood_ratios(simulated.problem, left, robot)
        is_simulation = (
            min(ratio) > -INTEGRATOR.least_evidence and sum(ratio) > 0.0
            if known
            else _is_shown_by_positions(ratio)
        )
        if not is_simulation or not _is_noise_alone(left, noise):
            continue
        other = conclude(simulated, used, run, selection.refine(fitted))
        fewer = set(other.explanation.hypothesis.terms) <= set(start.terms)
        if fewer and other.verdict == "explained":
            return changed_setup, other
    return None


def _with_and_without_efforts(trials: TrialSet) -> list[TrialSet]:
    """The recordings with their efforts and, if they have efforts, without them.

    MuJoCo computes an actuator's force before it integrates the step. A force that is logged with
    the positions after the step is one step old, and so precise that it would bias the fit.
    """
    ways = [trials]
    if any(t.effort is not None for t in (*trials.fit, *trials.held_out)):
        fit, aside = (
            tuple(replace(t, effort=None) for t in some) for some in (trials.fit, trials.held_out)
        )
        ways.append(replace(trials, fit=fit, held_out=aside))
    return ways


def _likeliest_substeps(found: SearchResult, robot: FloatArray, noise: FloatArray) -> int:
    """Number of substeps with the largest likelihood; 0 if the correction explains more.

    The parameters of the findings are refitted to first order.
    """
    fitted = found.pruned.fitted
    problem = found.prepared.problem.at(found.explanation.hypothesis)
    rows = problem.fit
    if (
        len(problem.discretization_error) < len(problem.simulator.segments)
        or not fitted.jacobian.size
    ):
        return 0
    inside = np.repeat(np.isin(problem.all_segments, rows), problem.lengths(problem.all_segments))
    joints = len(problem.joints)
    slopes = fitted.jacobian[:, :joints]
    error = np.concatenate([problem.discretization_error[int(s)].position for s in rows])
    if (
        len(slopes) != len(error)
        or (np.sqrt(np.mean(error**2, axis=0)) < INTEGRATOR.seen * noise).all()
    ):
        return 0
    design = (slopes / noise[:, None]).reshape(len(error) * joints, -1)

    def misfit(residual: FloatArray) -> float:
        flat = (residual / noise).ravel()
        remaining = flat - design @ np.linalg.lstsq(design, flat, rcond=None)[0]
        return float(np.sum(np.log(np.mean(remaining.reshape(-1, joints) ** 2, axis=0))))

    none = misfit(robot[inside])
    each = {k: misfit(robot[inside] + error / k) for k in SUBSTEPS}
    best = min(each, key=lambda k: each[k])
    return best if each[best] < none else 0


def _has_forces_of_the_step(
    robot: Problem, found: Hypothesis, simulation: Problem, refitted: Hypothesis
) -> bool:
    """Whether the logged efforts of every recording are those of the previous simulation step.

    Their residual must be less than half of the residual of the prediction for a robot, at the
    best of three neighbouring steps.

    Args:
        robot, found: the problem with the correction of the integration error, and its findings.
        simulation, refitted: the problem without it, and the findings fitted to it.
    """

    def deviations(problem: Problem, hypothesis: Hypothesis) -> list[FloatArray]:
        """(steps, joints) RMS deviations: at the stamp, a step earlier, a step later."""
        rows = problem.all_segments
        values = effect_values([hypothesis] * len(rows), len(problem.joints), problem.scales)
        predicted = problem.simulator.efforts_at_neighbouring_steps(rows, values)
        return [
            np.sqrt(np.mean((np.stack(p) - robot.simulator.segments[s].effort) ** 2, axis=1))
            for s, p in zip(rows, predicted, strict=True)
        ]

    if any(s.effort is None for s in robot.simulator.segments):
        return False
    ways = zip(deviations(simulation, refitted), deviations(robot, found), strict=True)
    return all((a[_EARLIER] < INTEGRATOR.effort_closer * b.min(axis=0)).all() for a, b in ways)


def _is_noise_alone(left: FloatArray, noise: FloatArray) -> bool:
    """Whether only noise remains at every joint."""
    if not np.isfinite(left).all():
        return False
    return bool((np.sqrt(np.mean(left**2, axis=0)) <= INTEGRATOR.noise_alone * noise).all())


def _is_shown_by_positions(ratio: Sequence[float]) -> bool:
    """Whether every recording is predicted better, and all together significantly."""
    return sum(ratio) >= INTEGRATOR.least_evidence and min(ratio) > 0.0


def _log_likelihood_ratios(problem: Problem, left: FloatArray, robot: FloatArray) -> list[float]:
    """Log-likelihood ratio of simulation to robot by recording; minus infinity if it diverges."""
    owner = [s.trial for s in problem.simulator.segments]
    ends = np.cumsum([0, *problem.lengths(problem.all_segments)])
    ratio = []
    for trial in dict.fromkeys(owner):
        of_trial = [i for i, o in enumerate(owner) if o == trial]
        rows = np.concatenate([np.arange(ends[i], ends[i + 1]) for i in of_trial])
        lengths = [int(ends[i + 1] - ends[i]) for i in of_trial]
        counts = np.minimum(
            effective_samples(left[rows], lengths), effective_samples(robot[rows], lengths)
        )
        squares = [np.mean(x[rows] ** 2, axis=0) for x in (left, robot)]
        ratio.append(0.5 * float(np.sum(counts * np.log(squares[1] / squares[0]))))
    return [r if np.isfinite(r) else -np.inf for r in ratio]
