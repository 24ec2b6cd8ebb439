"""Whether recordings have a simulation's own step in them, by the effects that were found.

The same effects are fitted with the integration error of a step left in. Recordings come from a
simulation only if that follows every recording better, leaves noise alone and needs no new effect.
So a step of 2 ms under a damping of 0.8 N*m*s/rad, which would read 5 % too little damping, is seen
where it is three hundredths of the noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.evidence import effective_samples
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.prepare import NOISE
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.search.stepwise_selection import StepwiseSelection
from pytest_twin.diagnosis.search_result import (
    SearchResult,
    build_problem,
    conclude,
    residuals_everywhere,
)

SUBSTEPS = (1, 2, 4, 5)
"""Steps, for each of the model's, of the simulations that are tried."""
_NATS = 5.0
"""Log-likelihood ratio over all recordings from which a simulation made them: odds of 150 to 1.
Three recordings of 4 s at 100 Hz that MuJoCo made at 2 ms reach 13, where the step's error is
a fifth of the noise; two reach 10."""
_NOISE_ALONE = 1.1
"""RMS residual, in units of the encoder noise as it was estimated, that is noise alone."""
_SEEN = 0.2
"""The same of the integration error from which it can be seen at all: under a fifth of the noise a
thousand samples tell it from none no more."""


def with_detected_timestep(
    found: SearchResult, given: ModelSetup, run: Run
) -> tuple[ModelSetup, SearchResult] | None:
    """The same effects with the error of a simulation's step left in, where every recording is
    followed better so; None where not.

    Args:
        found: with the error of the step taken out.
        given: the model, so stepped.
        run: the diagnosis.
    """
    prepared, start = found.prepared, found.explained.hypothesis
    problem = prepared.problem
    positions = all(s.mode == "position" and not s.amid for s in problem.simulator.segments)
    if given.substeps or not start.terms or not positions or found.verdict != "explained":
        return None
    robot = residuals_everywhere(problem, start)[:, : len(problem.joints)]
    noise = prepared.floor_parts[NOISE]
    substeps = _likeliest(found, robot, noise)
    if not substeps:
        return None
    stepped = replace(given, substeps=substeps)
    there, trials = build_problem(stepped, found.trials, [], window=prepared.window)
    selection = StepwiseSelection(there.problem, run)
    comparison = selection.comparison
    rival = comparison.settled(comparison.scored_without_fit(start))
    left = residuals_everywhere(there.problem, rival.hypothesis)[:, : len(problem.joints)]
    if left.shape != robot.shape or not _confirmed(there.problem, left, robot, noise):
        return None
    other = conclude(there, trials, selection, selection.run(rival))
    fewer = set(other.explained.hypothesis.terms) <= set(start.terms)
    return (stepped, other) if fewer and other.verdict == "explained" else None


def _likeliest(found: SearchResult, robot: FloatArray, noise: FloatArray) -> int:
    """Steps for each of the model's that explain most to first order, the parameters of what was
    found free; 0 where none explains more than none.
    """
    problem, fitted = found.prepared.problem, found.pruned.fitted
    rows = problem.fit
    if len(problem.defect) < len(problem.simulator.segments) or not fitted.jacobian.size:
        return 0
    inside = np.repeat(np.isin(problem.everywhere, rows), problem.lengths(problem.everywhere))
    joints = len(problem.joints)
    slopes = fitted.jacobian[:, :joints]
    error = np.concatenate([problem.defect[int(s)].position for s in rows])
    if len(slopes) != len(error) or (np.sqrt(np.mean(error**2, axis=0)) < _SEEN * noise).all():
        return 0
    design = (slopes / noise[:, None]).reshape(len(error) * joints, -1)

    def left(residual: FloatArray) -> float:
        flat = (residual / noise).ravel()
        rest = flat - design @ np.linalg.lstsq(design, flat, rcond=None)[0]
        return float(np.sum(np.log(np.mean(rest.reshape(-1, joints) ** 2, axis=0))))

    none = left(robot[inside])
    each = {k: left(robot[inside] + error / k) for k in SUBSTEPS}
    best = min(each, key=lambda k: each[k])
    return best if each[best] < none else 0


def _confirmed(problem: Problem, left: FloatArray, robot: FloatArray, noise: FloatArray) -> bool:
    """Whether every recording is followed better, and noise alone is left."""
    if not np.isfinite(left).all():
        return False
    if (np.sqrt(np.mean(left**2, axis=0)) > _NOISE_ALONE * noise).any():
        return False
    owner = [s.trial for s in problem.simulator.segments]
    ends = np.cumsum([0, *problem.lengths(problem.everywhere)])
    ratio = []
    for trial in dict.fromkeys(owner):
        mine = [i for i, o in enumerate(owner) if o == trial]
        rows = np.concatenate([np.arange(ends[i], ends[i + 1]) for i in mine])
        lengths = [int(ends[i + 1] - ends[i]) for i in mine]
        counts = np.minimum(
            effective_samples(left[rows], lengths), effective_samples(robot[rows], lengths)
        )
        squares = [np.mean(x[rows] ** 2, axis=0) for x in (left, robot)]
        ratio.append(0.5 * float(np.sum(counts * np.log(squares[1] / squares[0]))))
    return sum(ratio) >= _NATS and min(ratio) > 0.0
