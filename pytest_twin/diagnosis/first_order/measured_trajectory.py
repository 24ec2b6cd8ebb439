"""Motion along which laws are evaluated: the prediction of a hypothesis plus its smoothed error.

A law that the model lacks acts on the real motion, not on the predicted one. Its force is evaluated
along the measured motion, without a further simulation (equation error). Measured velocities and
accelerations are those of the simulation plus derivatives of the smoothed residual. Reversals stay
sharp, and noise stays small.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.settings import FIRST_ORDER
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.smoothing import derivatives
from pytest_twin.diagnosis.verdict import UNSEEN
from pytest_twin.estimation.hypothesis import Hypothesis


@dataclass(frozen=True, slots=True)
class MeasuredTrajectory:
    """Segments on a uniform grid; shorter ones are padded with their last state.

    Attributes:
        segments: (segments,) indices among the segments of the problem.
        steps: number of model steps between two samples.
        interval: time between two samples, s.
        time: (segments, samples) s on each trial's clock.
        position, velocity, acceleration: (segments, samples, joints) of the measured motion, in
            rad or m and s.
        predicted_position, predicted_velocity: (segments, samples, joints) of the hypothesis.
        reading: for each segment, (stamps, joints) predicted encoder readings, rad or m.
        effort: for each segment, (stamps, joints) predicted effort readings, N*m or N.
        at_rest: (segments, samples, joints) whether the joint hardly moves in both motions.
        slip_velocity: (joints,) velocity over which dry friction changes its sign, rad/s or m/s.
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
        """Mean positions and velocities of the measured and the predicted motion."""
        return (
            0.5 * (self.position + self.predicted_position),
            0.5 * (self.velocity + self.predicted_velocity),
        )

    @property
    def predicted(self) -> MeasuredTrajectory:
        """The predicted motion in place of the measured one; accelerations are unchanged."""
        return replace(self, position=self.predicted_position, velocity=self.predicted_velocity)


def measured_trajectory(
    problem: Problem,
    hypothesis: Hypothesis,
    segments: NDArray[np.int64],
) -> MeasuredTrajectory:
    """The measured motion of ``segments``: the prediction of a hypothesis plus its smoothed error.

    Args:
        hypothesis: the best hypothesis so far.
        segments: indices of the problem's segments.
    """
    simulator = problem.simulator
    joints = len(problem.joints)
    q, v, predictions = problem.trajectories_with_readings(hypothesis, segments)
    steps = max(1, int(FIRST_ORDER.grid / simulator.timestep + 1e-9))
    q, v = q[:, ::steps], v[:, ::steps]
    samples = q.shape[1]
    interval = steps * simulator.timestep
    starts = np.array([simulator.segments[s].start for s in segments])
    time = starts[:, None] + interval * np.arange(samples)
    shift = np.zeros((3, *q.shape))
    stuck = problem.floor[:joints] >= UNSEEN
    for i, (s, predicted) in enumerate(zip(segments, predictions, strict=True)):
        stamps = simulator.segments[s].time
        error = np.nan_to_num(simulator.segments[s].position - predicted.position)
        # A stuck encoder measures no motion; the joint is assumed to move as predicted.
        error[:, stuck] = 0.0
        for order, d in enumerate(derivatives(stamps, error, FIRST_ORDER.smooth)):
            for j in range(joints):
                shift[order, i, :, j] = np.interp(time[i], stamps, d[:, j])
    a = np.gradient(v, interval, axis=1) if samples > 1 else np.zeros_like(v)
    typical = problem.scales.of["velocity"]
    rest = FIRST_ORDER.at_rest * typical
    at_rest = (np.abs(v) < rest) & (np.abs(v + shift[1]) < rest)
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
        at_rest=at_rest,
        slip_velocity=FIRST_ORDER.slip * typical,
    )
