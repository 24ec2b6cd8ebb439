"""Times of command steps between two stamps, where the setpoint moves on between the stamps.

The log of such a setpoint shows that it stepped between two stamps, not when. A line from one stamp
to the other is up to half a period early or late, and the error of a step of 0.5 rad at 100 Hz is
larger than that of most missing physics. The motion shows when the step acted. Each time is fitted
to it with the smooth parameters of the joints that explain the rest of the recordings, so a delay
of the drive is not mistaken for a late step.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.build_problem import build_problem
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.signal_meaning.joint_fit import SmoothParameterFit, SmoothParameters
from pytest_twin.diagnosis.signal_meaning.settings import INTERPOLATION, JOINT_FIT
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.errors import TwinError
from pytest_twin.trial import Trial

_PRIOR_DEVIATION = 1.0 / np.sqrt(12.0)
"""Standard deviation of a time about which nothing is known, in periods."""
_MARGIN = 0.02
"""Smallest distance of a step from both stamps, in periods."""
_STEP_DURATION = 1e-6
"""Duration of a step, s."""


@dataclass(frozen=True, slots=True)
class StepTimes:
    """Fits the times of command steps.

    Attributes:
        setup: the model with its simulation settings.
        space, fit: smooth parameters of the joints, fitted to recordings of the same controller.
        period: command period of the recordings, s.
        known: file and start of a recording -> times of its steps, as shares of their periods; None
            where they cannot be fitted.
    """

    setup: ModelSetup
    space: SmoothParameters
    fit: SmoothParameterFit
    joints: tuple[str, ...]
    period: float
    known: dict[tuple[Path, float], FloatArray | None] = field(default_factory=dict)

    def shares(self, trial: Trial) -> FloatArray | None:
        """(steps,) times of the steps of a trial, as shares of their periods.

        None without a step, if the model cannot be simulated under the commands, and if commands
        are efforts, because errors of their motion grow within a few tenths of a second.
        """
        key = trial.path, trial.offset
        if key not in self.known:
            self.known[key] = self._fit_shares(trial)
        return self.known[key]

    def _fit_shares(self, trial: Trial) -> FloatArray | None:
        steps = step_intervals(trial.command)
        if not len(steps) or trial.hardest_mode == "effort" or trial.own_commands is not None:
            return None
        trial = replace(trial, command_between="interpolated", velocity=None, effort=None)
        ends = [np.full(len(steps), share) for share in (_MARGIN, 1.0 - _MARGIN)]
        both = [with_steps_at(trial, share) for share in ends]
        try:
            prepared, kept = build_problem(
                self.setup, TrialSet(tuple(both), (), ()), [], scales=self.space.problem.scales
            )
        except TwinError:
            # The diagnosis itself reports the error of this recording.
            return None
        problem = prepared.problem
        if problem.joints != self.joints or len(kept.fit) != len(both):
            return None
        hypothesis = self.space.hypothesis(self.fit.theta)
        early, late = (
            np.array([s for s, t in enumerate(prepared.segment_trial) if t == k]) for k in (0, 1)
        )
        problem = problem.at(hypothesis)
        residuals = [problem.residuals([hypothesis], rows)[0] for rows in (early, late)]
        time = np.concatenate([problem.simulator.segments[s].time for s in early])
        if residuals[0].shape != residuals[1].shape or not np.isfinite(residuals).all():
            return None
        shares = fit_step_shares(residuals[0], residuals[1], time, trial.command_time[steps])
        return _MARGIN + (1.0 - 2.0 * _MARGIN) * shares


def step_intervals(command: FloatArray) -> NDArray[np.int64]:
    """Indices of the commands before a step, in (times, joints) commands: a joint's command rests,
    changes in one period, and rests again.
    """
    change = np.abs(np.diff(command, axis=0))
    is_large = change > INTERPOLATION.jump_of_range * np.ptp(command, axis=0)
    return np.flatnonzero((_is_jump(command) & is_large).any(axis=1))


def _is_jump(command: FloatArray) -> NDArray[np.bool_]:
    """(times - 1, joints) whether a command changes much more than in the periods before and after.

    False for the first and the last period, which lack a neighbour.
    """
    change = np.abs(np.diff(command, axis=0))
    found = np.zeros(change.shape, dtype=bool)
    found[1:-1] = change[1:-1] > INTERPOLATION.jump * np.maximum(change[:-2], change[2:])
    return found


def fit_step_shares(
    early: FloatArray, late: FloatArray, time: FloatArray, starts: FloatArray
) -> FloatArray:
    """(steps,) times of steps as shares of their periods, 0 to 1.

    Between two stamps a step that acts later changes the motion in proportion to its delay. The
    estimate is the mean of the posterior, with a prior that knows nothing within the period.

    Args:
        early, late: (samples, joints) residuals with all steps at the first and at the second of
            their stamps, rad or m.
        time: (samples,) s.
        starts: (steps,) first stamp of each step, s.
    """
    change = late - early
    size = np.sqrt(np.mean(change**2, axis=0))
    weight = np.where(size > 0.0, 1.0 / np.maximum(size, 1e-300), 0.0)
    out = np.full(len(starts), 0.5)
    for i, (start, after) in enumerate(zip(starts, [*starts[1:], np.inf], strict=True)):
        inside = (time >= start) & (time < min(after, start + INTERPOLATION.settles))
        slope = (change[inside] * weight).ravel()
        square = float(slope @ slope)
        if square <= 0.0:
            continue
        target = -(early[inside] * weight).ravel()
        share = float(slope @ target) / square
        left = target - share * slope
        variance = JOINT_FIT.smooth_samples * float(left @ left) / max(len(left) - 1, 1) / square
        weight_of_data = _PRIOR_DEVIATION**2 / (_PRIOR_DEVIATION**2 + variance)
        out[i] = np.clip(0.5 + weight_of_data * (share - 0.5), 0.0, 1.0)
    return out


def with_steps_at(trial: Trial, shares: FloatArray) -> Trial:
    """The trial with its steps at (steps,) shares of their periods; other joints move linearly."""
    steps = step_intervals(trial.command)
    jumps = _is_jump(trial.command)
    times: list[float] = []
    rows: list[FloatArray] = []
    for k, share in zip(steps, shares, strict=True):
        start, end = trial.command_time[k : k + 2]
        before, after = trial.command[k : k + 2]
        at = start + share * (end - start)
        moving = before + share * (after - before)
        times += [at - 0.5 * _STEP_DURATION, at + 0.5 * _STEP_DURATION]
        rows += [np.where(jumps[k], before, moving), np.where(jumps[k], after, moving)]
    places = np.repeat(steps + 1, 2)
    return replace(
        trial,
        command_time=np.insert(trial.command_time, places, times),
        command=np.insert(trial.command, places, np.array(rows), axis=0),
    )
