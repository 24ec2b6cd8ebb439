"""Motion along which laws are evaluated: what a hypothesis predicts, moved to what was measured.

A law that the model lacks acts on the real motion, not on the predicted one. Where the two lie
close, what it adds can be read off along the measured motion, without a simulation of its own
(equation error). Measured velocities and accelerations come from the simulation plus derivatives of
the smoothed residual, so that reversals stay sharp and noise stays small.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.hypothesis import Hypothesis
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.smoothing import derivatives
from pytest_twin.diagnosis.verdict import UNSEEN

_GRID = 0.005
"""s between samples of the motion, at most."""
_SMOOTH = 0.1
# Of the typical velocity: below the first both motions stand, over the second friction reverses.
_AT_REST, _SLIP = 0.02, 0.005


@dataclass(frozen=True, slots=True)
class MeasuredTrajectory:
    """Segments on an even grid; shorter ones are padded with their last state.

    Attributes:
        segments: (segments,) of the problem.
        steps: of the model between two samples.
        interval: s between two samples.
        time: (segments, samples) s on each trial's clock.
        position, velocity, acceleration: (segments, samples, joints) of the measured motion.
        predicted_position, predicted_velocity: the same of the hypothesis.
        reading: per segment, (stamps, joints) what it predicts that the encoders read.
        effort: the same of its effort sensors.
        at_rest: (segments, samples, joints) where neither moves.
        slip_velocity: (joints,) rad/s or m/s, over which dry friction changes its sign.
    """

    segments: NDArray[np.int64]
    steps: int
    interval: float
    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    predicted_position: FloatArray
    predicted_velocity: FloatArray
    reading: tuple[FloatArray, ...]
    effort: tuple[FloatArray, ...]
    at_rest: NDArray[np.bool_]
    slip_velocity: FloatArray

    @property
    def midway(self) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities between measured and predicted."""
        return (
            0.5 * (self.position + self.predicted_position),
            0.5 * (self.velocity + self.predicted_velocity),
        )

    @property
    def predicted(self) -> MeasuredTrajectory:
        """The predicted motion in the measured one's place; accelerations stay."""
        return replace(self, position=self.predicted_position, velocity=self.predicted_velocity)


def measured_trajectory(
    problem: Problem,
    hypothesis: Hypothesis,
    segments: NDArray[np.int64],
) -> MeasuredTrajectory:
    """The motion of ``segments`` under a hypothesis, moved by what its prediction is off.

    Args:
        problem: what to explain.
        hypothesis: the best so far.
        segments: indices of the problem's segments.
    """
    simulator = problem.simulator
    joints = len(problem.joints)
    q, v, predictions = problem.followed(hypothesis, segments)
    steps = max(1, int(_GRID / simulator.timestep + 1e-9))
    q, v = q[:, ::steps], v[:, ::steps]
    samples = q.shape[1]
    interval = steps * simulator.timestep
    starts = np.array([simulator.segments[s].start for s in segments])
    time = starts[:, None] + interval * np.arange(samples)
    shift = np.zeros((3, *q.shape))
    stuck = problem.floor[:joints] >= UNSEEN
    for i, (s, predicted) in enumerate(zip(segments, predictions, strict=True)):
        stamps = simulator.segments[s].time
        off = np.nan_to_num(simulator.segments[s].position - predicted.position)
        # An encoder that is stuck measured no motion: its joint moves as predicted.
        off[:, stuck] = 0.0
        for order, d in enumerate(derivatives(stamps, off, _SMOOTH)):
            for j in range(joints):
                shift[order, i, :, j] = np.interp(time[i], stamps, d[:, j])
    a = np.gradient(v, interval, axis=1) if samples > 1 else np.zeros_like(v)
    typical = problem.scales.of["velocity"]
    rest = _AT_REST * typical
    standing = (np.abs(v) < rest) & (np.abs(v + shift[1]) < rest)
    return MeasuredTrajectory(
        segments=segments,
        steps=steps,
        interval=interval,
        time=time,
        position=q + shift[0],
        velocity=v + shift[1],
        acceleration=a + shift[2],
        predicted_position=q,
        predicted_velocity=v,
        reading=tuple(p.position for p in predictions),
        effort=tuple(p.effort for p in predictions),
        at_rest=standing,
        slip_velocity=_SLIP * typical,
    )
