"""Simulated readings of hypotheses along several motions, in multiples of the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.delays import without_delays
from pytest_twin.diagnosis.patched.replay import whole_segment
from pytest_twin.diagnosis.problem import joint_scales, replay_nominal
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Predicted, Segment
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Scales, effect_values
from pytest_twin.excitation.approved_limits import ApprovedLimits
from pytest_twin.excitation.closed_loop import SETTLE, servo_modes, trial_of
from pytest_twin.excitation.motion import Motion
from pytest_twin.realization.model import Realization

_ROWS = 200
"""Largest number of simulations in one batch, which bounds its memory."""


@dataclass(frozen=True)
class Noise:
    """Standard deviation of what no model explains, for every signal.

    Attributes:
        position: (j,) rad or m; None if the motion is taken as given.
        effort: (j,) N*m or N; None if efforts are not measured.
    """

    position: FloatArray | None
    effort: FloatArray | None


class Responses:
    """Readings of hypotheses along motions, simulated with the model's servos.

    Attributes:
        motions: the motions.
        scales: typical sizes of the parameters.

    Args:
        realization: the model; every approved joint has a position or velocity servo.
        scales: those of other motions; by default of these.
    """

    def __init__(
        self,
        realization: Realization,
        approved: ApprovedLimits,
        motions: Sequence[Motion],
        noise: Noise,
        scales: Scales | None = None,
    ) -> None:
        self.motions = list(motions)
        self._noise = noise
        modes = servo_modes(realization, approved.names)
        assert modes is not None
        stepped = without_delays(realization)
        segments = []
        for motion in motions:
            trial = trial_of(motion, realization, approved.names, modes)
            segments.append(whole_segment(stepped, trial, approved.names, 1.0))
        simulator = BatchSimulator(segments, approved.names)
        nominal = replay_nominal(simulator)
        # Sizes of tracking errors need the simulated motion instead of the commanded one.
        moved = [_along(s, p) for s, p in zip(segments, nominal, strict=True)]
        self.simulator = BatchSimulator(moved, approved.names)
        self.scales = joint_scales(self.simulator, nominal) if scales is None else scales
        self._kept = [segment.time > SETTLE for segment in segments]

    @property
    def lengths(self) -> list[int]:
        """Number of samples of each motion."""
        return [int(kept.sum()) for kept in self._kept]

    @property
    def floor(self) -> FloatArray:
        """(signals,) noise of every signal, in the unit of the readings: 1."""
        return np.ones(len(self.simulator.joints) * (1 if self._noise.effort is None else 2))

    def of(self, rows: Sequence[tuple[int, Hypothesis]]) -> list[FloatArray]:
        """(n, signals) readings for pairs of a motion and a hypothesis, in standard deviations.

        The signals are the positions of all joints, then their efforts if these are measured.
        """
        readings: list[FloatArray] = []
        for first in range(0, len(rows), _ROWS):
            some = rows[first : first + _ROWS]
            which: NDArray[np.int64] = np.array([motion for motion, _ in some], dtype=np.int64)
            values = effect_values(
                [hypothesis for _, hypothesis in some], len(self.simulator.joints), self.scales
            )
            with np.errstate(over="ignore", invalid="ignore"):
                predicted = self.simulator.simulate(which, values)
            readings += [
                self._scaled(one, int(motion)) for motion, one in zip(which, predicted, strict=True)
            ]
        return readings

    def nominal(self) -> list[FloatArray]:
        """(n, signals) readings of the model itself along every motion."""
        return self.of([(i, EMPTY) for i in range(len(self.motions))])

    def _scaled(self, predicted: Predicted, motion: int) -> FloatArray:
        kept = self._kept[motion]
        assert self._noise.position is not None
        position = predicted.position[kept] / self._noise.position
        if self._noise.effort is None:
            return position
        return np.concatenate([position, predicted.effort[kept] / self._noise.effort], axis=1)


def _along(segment: Segment, predicted: Predicted) -> Segment:
    if not np.isfinite(predicted.position).all():
        return segment
    return replace(segment, position=predicted.position)
