"""Errors that a model had before a change: no sign of the change, and noise beside it.

An imperfect model leaves a residual in earlier recordings. Where a later recording repeats the
commands of earlier ones, their residual is subtracted: the difference of the recordings is then
compared with the difference of the predictions. The error that remains differs from one motion to
another; a fall with the drive off is predicted far worse than a slow sine. So each recording is
weighted by the error of the model before (weighted least squares; Aitken 1935): in the repeated
motion, or in all earlier recordings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.estimation.hypothesis import EMPTY
from pytest_twin.estimation.score import NOISE_FLOORS
from pytest_twin.trial import Trial
from pytest_twin.trial.repeated import is_repeated


@dataclass(frozen=True, slots=True)
class _EarlierResidual:
    """What the model leaves in one earlier recording.

    Attributes:
        time: (n,) stamps, s.
        residual: (n, joints) measured minus predicted positions, rad or m.
    """

    trial: Trial
    time: FloatArray
    residual: FloatArray

    @property
    def mean_square(self) -> FloatArray:
        """(joints,) of the residual."""
        return np.asarray(np.mean(self.residual**2, axis=0))

    def at(self, time: FloatArray) -> FloatArray:
        """(len(time), joints) residual, interpolated linearly."""
        return np.stack([np.interp(time, self.time, column) for column in self.residual.T], axis=1)


def with_known_errors(
    problem: Problem,
    trials: Sequence[Trial],
    setup: ModelSetup,
    earlier: Sequence[Trial],
    window: float | None,
) -> Problem:
    """The problem without the residual of earlier recordings, which counts as noise.

    Args:
        trials: the trial of each segment.
        setup: the model, with the effects that it had before.
        earlier: recordings before a change; none changes nothing.
        window: length of the windows of the problem, s.
    """
    if not earlier:
        return problem
    residuals = _residuals(setup, earlier, problem.joints, window)
    if not residuals:
        return problem
    usual = np.mean([each.mean_square for each in residuals], axis=0)
    subtracted: dict[int, FloatArray] = {}
    variances = []
    for s, (segment, trial) in enumerate(zip(problem.simulator.segments, trials, strict=True)):
        same = [each for each in residuals if is_repeated(trial, each.trial)]
        variances.append(np.mean([e.mean_square for e in same], axis=0) if same else usual)
        # A window starts from a measured state, which differs between recordings.
        if same and window is None and segment.mode == "position":
            each = np.array([repeated.at(segment.time) for repeated in same])
            subtracted[s] = each.mean(axis=0)
            if len(same) > 1:
                # The scatter of repetitions is the error of their mean difference.
                scatter = np.mean(each.var(axis=0, ddof=1), axis=0)
                variances[-1] = scatter * (1.0 + 1.0 / len(same))
    # The search takes residuals up to this many noise floors for noise.
    noise = np.sqrt(problem.floor**2 + np.array(variances) / NOISE_FLOORS**2)
    own = [problem.position_weights.get(s, np.ones(noise.shape[1])) for s in range(len(noise))]
    weights = np.array(own) / noise
    # The noise of a weighted position, with weights of mean square 1.
    floor = 1.0 / np.sqrt(np.mean(weights**2, axis=0))
    problem = _without(problem, subtracted)
    return replace(problem, floor=floor, position_weights=dict(enumerate(weights * floor)))


def _residuals(
    setup: ModelSetup, earlier: Sequence[Trial], joints: Sequence[str], window: float | None
) -> list[_EarlierResidual]:
    """What the model leaves in each earlier recording on which it does not diverge."""
    prepared = setup.prepare(earlier, (), window)
    problem = prepared.problem
    (errors,) = problem.errors([EMPTY], problem.all_segments)
    # Nothing is known of a joint that the earlier recordings lack.
    of_joints = np.zeros((len(errors), len(joints)))
    for k, joint in enumerate(joints):
        if joint in problem.joints:
            of_joints[:, k] = errors[:, problem.joints.index(joint)]
    owner = np.repeat(prepared.segment_trial, problem.lengths(problem.all_segments))
    time = np.concatenate([s.time for s in problem.simulator.segments])
    return [
        _EarlierResidual(trial, time[owner == k], of_joints[owner == k])
        for k, trial in enumerate(earlier)
        if np.isfinite(of_joints[owner == k]).all()
    ]


def _without(problem: Problem, subtracted: dict[int, FloatArray]) -> Problem:
    """The problem with (samples, joints) subtracted from the measured positions of segments."""
    if not subtracted:
        return problem
    simulator, refined = problem.simulator, problem.refined
    segments = [
        replace(s, position=s.position - subtracted[i]) if i in subtracted else s
        for i, s in enumerate(simulator.segments)
    ]

    def simulating(other: BatchSimulator) -> BatchSimulator:
        return BatchSimulator(
            segments, other.joints, threads=other.threads, refine=other.refine, fixed=other.fixed
        )

    changed = problem.with_simulator(
        simulating(simulator), None if refined is None else simulating(refined)
    )
    return changed if refined is None else changed.at(EMPTY)
