"""Joint zeros and link geometry as unknowns of a camera calibration, with their priors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.parameters import State, Variables
from pytest_twin.calibration.problem import CalibrationProblem
from pytest_twin.metrics.pose import rigid


@dataclass(frozen=True)
class Arm:
    """Flange poses as functions of joint zeros and link deviations.

    Attributes:
        problem: the calibration problem on the rows that have images, with only the arm's unknowns
            free.
        state: joint zeros and link deviations at which the steps are 0.
    """

    problem: CalibrationProblem
    state: State

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return self.problem.layout.count

    @property
    def precision(self) -> FloatArray:
        """(count,) inverse variances of the priors, 1/rad^2 or 1/m^2; 0 without a prior."""
        priors = [parameter.prior for parameter in self.problem.layout.parameters]
        return np.array([0.0 if prior is None else prior**-2 for prior in priors])

    def values(self, step: FloatArray) -> FloatArray:
        """(count,) deviations from the nominal design, the mean of the priors, rad and m."""
        layout, moved = self.problem.layout, self.moved(step)
        return np.concatenate([moved.zeros[list(layout.zeros)], moved.links])

    def moved(self, step: FloatArray) -> State:
        """The state after a step."""
        return self.problem.layout.moved(self.state, step)

    def flange(self, step: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 4, 4) ``base_from_flange``, m, and its (n, 6, count) change in the base's axes."""
        moving = self.problem.flange(Variables(self.problem.layout, self.state, step))
        poses = rigid(moving.rotation, moving.position)
        return poses, np.concatenate([moving.shift, moving.turn], axis=1)


def arm_of(problem: CalibrationProblem, rows: np.ndarray, state: State) -> Arm | None:
    """Return the arm's unknowns of a problem; None if it has none."""
    layout = problem.layout
    if not layout.zeros and not layout.links:
        return None
    bare = replace(problem.on_rows(rows), layout=replace(layout, poses=(), points=(), scale=False))
    return Arm(bare, state)
