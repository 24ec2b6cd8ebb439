"""Detection of recordings that a simulation made, with the effects of the incumbent.

The effects are fitted again without the correction of the integration error. Recordings come from a
simulation only if every recording is then predicted better and only noise remains. Example: a time
step of 2 ms with a damping of 0.8 N*m*s/rad biases the damping by -5 %, and is detected although
its error is 3 % of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.build_problem import build_problem
from pytest_twin.diagnosis.integrator_settings import INTEGRATOR
from pytest_twin.diagnosis.noise_levels import in_noise_floors
from pytest_twin.diagnosis.prepare import NOISE
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.model import Model
from pytest_twin.diagnosis.search.physics import SimulatedPhysics
from pytest_twin.diagnosis.simulation_settings import SUBSTEPS
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.estimation.hypothesis import Hypothesis, effect_values
from pytest_twin.estimation.score import effective_samples

_EARLIER = 1
"""Index of the previous step among the neighbouring steps of an effort."""
_ITERATIONS = 8
"""Iterations of a fit that decides between a robot and a simulation."""


def with_detected_timestep(
    physics: SimulatedPhysics, incumbent: Model
) -> tuple[SimulatedPhysics, Hypothesis] | None:
    """The recordings as those of a simulation, if all of them agree better with its time step.

    Args:
        physics: the robot and its whole recordings, with the correction of the integration error.
        incumbent: the best model so far.

    Returns:
        The physics with the detected time step and the fitted effects; None for a robot.
    """
    problem, setup = physics.problem, physics.setup
    positions = all(
        s.mode == "position" and not s.starts_in_motion for s in problem.simulator.segments
    )
    known = setup.substeps or setup.is_of_robot
    if known or not incumbent.hypothesis.terms or not positions:
        return None
    joints = len(problem.joints)
    levels = in_noise_floors(incumbent.residual[:, :joints], problem.floor)
    if (levels > VERDICT.at_floor).any():
        return None
    noise = np.maximum(physics.prepared.floor_parts[NOISE], np.finfo(np.float32).eps)
    substeps = _likeliest_substeps(problem, incumbent, noise)
    if not substeps:
        return None
    found, residual = _converged(physics, incumbent.hypothesis)
    robot = residual[:, :joints]
    for trials in _without_and_with_efforts(physics.trials):
        prepared, used = build_problem(
            replace(setup, substeps=substeps), trials, [], window=physics.prepared.window,
            scales=problem.scales,
        )  # fmt: skip
        simulation = SimulatedPhysics(
            replace(setup, substeps=substeps), prepared, used, physics.possible,
            between=physics.between,
        )  # fmt: skip
        refitted, residual = _converged(simulation, incumbent.hypothesis)
        left = residual[:, :joints]
        if left.shape != robot.shape:
            continue
        ratio = _log_likelihood_ratios(problem, left, robot)
        is_simulation = sum(ratio) >= INTEGRATOR.least_evidence and min(ratio) > 0.0
        if trials is not physics.trials:
            efforts = _EffortsAtSteps.of(problem, found, simulation.problem, refitted)
            # If the efforts show a simulation, the positions must only not contradict it.
            is_possible = min(ratio) > -INTEGRATOR.least_evidence and sum(ratio) > 0.0
            is_simulation = (
                efforts.are_one_step_old
                if is_simulation
                else (is_possible and efforts.show_simulation)
            )
        if is_simulation and _is_noise_alone(left, noise):
            return simulation, refitted
    return None


def _converged(physics: SimulatedPhysics, hypothesis: Hypothesis) -> tuple[Hypothesis, FloatArray]:
    """A hypothesis fitted with the corrections of its own parameters, and its residual."""
    (residual,) = physics.simulate([hypothesis], hypothesis)
    for _ in range(2):
        hypothesis, residual, _ = physics.fit(hypothesis, residual, _ITERATIONS, hypothesis)
    return hypothesis, residual


def _without_and_with_efforts(trials: TrialSet) -> list[TrialSet]:
    """The recordings without their efforts, if they have efforts, and with them.

    MuJoCo computes an actuator's force before it integrates the step. A force that is logged with
    the positions after the step is one step old, and so precise that it would bias the fit.
    """
    if all(t.effort is None for t in trials.fit):
        return [trials]
    without = tuple(replace(t, effort=None) for t in trials.fit)
    return [replace(trials, fit=without), trials]


def _likeliest_substeps(problem: Problem, incumbent: Model, noise: FloatArray) -> int:
    """Number of substeps with the largest likelihood; 0 if the correction explains more.

    The parameters of the incumbent are refitted to first order.
    """
    problem = problem.at(incumbent.hypothesis)
    joints, jacobian = len(problem.joints), incumbent.jacobian
    if len(problem.discretization_error) < len(problem.simulator.segments) or jacobian is None:
        return 0
    error = np.concatenate([problem.discretization_error[int(s)].position for s in problem.fit])
    if (np.sqrt(np.mean(error**2, axis=0)) < INTEGRATOR.seen * noise).all():
        return 0
    design = (jacobian[:, :joints] / noise[:, None]).reshape(len(error) * joints, -1)
    residual = incumbent.residual[:, :joints]

    def misfit(residual: FloatArray) -> float:
        flat = (residual / noise).ravel()
        remaining = flat - design @ np.linalg.lstsq(design, flat, rcond=None)[0]
        return float(np.sum(np.log(np.mean(remaining.reshape(-1, joints) ** 2, axis=0))))

    of_robot = misfit(residual)
    of_substeps = {k: misfit(residual + error / k) for k in SUBSTEPS}
    best = min(of_substeps, key=lambda k: of_substeps[k])
    return best if of_substeps[best] < of_robot else 0


@dataclass(frozen=True, slots=True)
class _EffortsAtSteps:
    """RMS deviations of the logged efforts, one array for each recording.

    Attributes:
        simulation, robot: (steps, joints) deviations of the predictions at the stamp, a step
            earlier and a step later.
    """

    simulation: list[FloatArray]
    robot: list[FloatArray]

    @classmethod
    def of(
        cls, robot: Problem, found: Hypothesis, simulation: Problem, refitted: Hypothesis
    ) -> _EffortsAtSteps:
        """The deviations of two problems, each with its fitted effects."""

        def deviations(problem: Problem, hypothesis: Hypothesis) -> list[FloatArray]:
            rows = problem.all_segments
            values = effect_values([hypothesis] * len(rows), len(problem.joints), problem.scales)
            predicted = problem.simulator.efforts_at_neighbouring_steps(rows, values)
            logged = [robot.simulator.segments[s].effort for s in rows]
            return [
                np.full((3, len(problem.joints)), np.inf) if effort is None
                else np.sqrt(np.mean((np.stack(p) - effort) ** 2, axis=1))
                for effort, p in zip(logged, predicted, strict=True)
            ]  # fmt: skip

        return cls(deviations(simulation, refitted), deviations(robot, found))

    @property
    def are_one_step_old(self) -> bool:
        """Whether the efforts are those of the previous step, not those at the stamp."""
        return all(
            (d[_EARLIER] < INTEGRATOR.effort_closer * np.delete(d, _EARLIER, axis=0)).all()
            for d in self.simulation
        )

    @property
    def show_simulation(self) -> bool:
        """Whether the previous step of a simulation is closer than any step of a robot."""
        return all(
            (a[_EARLIER] < INTEGRATOR.effort_closer * b.min(axis=0)).all()
            for a, b in zip(self.simulation, self.robot, strict=True)
        )


def _is_noise_alone(left: FloatArray, noise: FloatArray) -> bool:
    """Whether only noise remains at every joint."""
    return bool((in_noise_floors(left, noise) <= INTEGRATOR.noise_alone).all())


def _log_likelihood_ratios(
    problem: Problem, left: FloatArray, robot: FloatArray
) -> Sequence[float]:
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
