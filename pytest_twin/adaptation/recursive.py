"""Bounded recursive least squares of named parameters over consecutive windows of motion.

The prediction of a window starts at its first measured state. Its error over the window is the
innovation, which is linearized in the parameters. The recursion is the recursive prediction error
method with forgetting (Ljung, "System Identification", 2nd ed., 1999, ch. 11), projected onto the
bounds. Each window is predicted before its own measurements update anything.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pytest_twin.adaptation.updated_parameters import predicted_positions
from pytest_twin.adaptation_spec import UpdateSpec
from pytest_twin.arrays import FloatArray
from pytest_twin.open_loop import Row
from pytest_twin.realization import Realization
from pytest_twin.time_limit import skips
from pytest_twin.trial import Trial

_INDEPENDENT = 10.0
"""Number of independent samples per window and joint. Neighbouring samples share the model
error."""
_STEP = 1e-3
"""Finite-difference step, as a fraction of the width of the bounds."""
_OUTLIER = 4.0
"""Ratio to the expected innovation above which a window is treated as a fault and not used."""
_MEMORY = 0.8
"""Weight of the past in the running errors of base and update."""
_WORSE = 1.02
"""Ratio of the running errors of update and base above which the base parameters are used."""
_SLOPE_SAMPLES = 5
"""Number of samples before a window whose slope is the initial velocity, if none was recorded."""

Disturb = Callable[[FloatArray, FloatArray], "FloatArray | None"]
"""Function from times (s) and measured positions (n, j) of a window to disturbed positions; None
means that the process restarts."""


@dataclass(frozen=True, slots=True)
class Window:
    """One window of motion.

    Attributes:
        start: time from the trial's first state, s.
        base_rms, updated_rms: RMS error of the prediction with base parameters and with the
            parameters in use, against the undisturbed measurement, rad or m.
        parameters: parameters in use after the window.
        state: ``updated``, ``base`` (fallback; the recursion continues), or the reason why nothing
            was updated.
        side: (p,) -1 where the estimate after the window is at its lower bound, 1 at its upper
            bound, else 0.
    """

    start: float
    base_rms: float
    updated_rms: float
    parameters: FloatArray
    state: str
    side: FloatArray


@dataclass(slots=True)
class Recursion:
    """State of the recursive estimation.

    Attributes:
        base: (p,) parameters of the base model.
        value, covariance: (p,) estimate and (p, p) covariance.
        has_fallback: whether the base parameters are in use.
    """

    spec: UpdateSpec
    base: FloatArray
    value: FloatArray = field(init=False)
    covariance: FloatArray = field(init=False)
    has_fallback: bool = False
    usual: float | None = None
    errors: FloatArray | None = None

    def __post_init__(self) -> None:
        self.restart()

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """(p,) lower and upper bounds."""
        low, high = np.array(list(self.spec.parameters.values())).T
        return low, high

    @property
    def prior(self) -> FloatArray:
        """(p, p) initial covariance: the standard deviation is a quarter of the bounds' width."""
        low, high = self.bounds
        return np.diag(((high - low) / 4.0) ** 2)

    @property
    def in_use(self) -> FloatArray:
        """(p,) parameters for predicting the next window."""
        return self.base if self.has_fallback else self.value

    def restart(self) -> None:
        """Reset the estimate to the base."""
        self.value, self.covariance = self.base.copy(), self.prior
        self.has_fallback, self.usual, self.errors = False, None, None

    def update(self, jacobian: FloatArray, innovation: FloatArray, share: float) -> str:
        """Update the estimate with one window.

        Args:
            jacobian: (m, p) derivative of the predictions at ``value``.
            innovation: (m,) measured minus predicted at ``value``, rad or m.
            share: number of samples per independent sample, a factor on the noise variance.

        Returns:
            ``updated``, or the reason why the window was not used.
        """
        if not (np.isfinite(jacobian).all() and np.isfinite(innovation).all()):
            return "no finite measurement"
        size = float(np.sqrt(np.mean(np.square(innovation))))
        if self.usual is not None and size > _OUTLIER * max(self.usual, self.spec.noise):
            return "the error is not of the usual size"
        self.usual = size if self.usual is None else 0.8 * self.usual + 0.2 * size
        # The model error is part of the noise of the update.
        variance = share * max(self.spec.noise, size) ** 2
        covariance: FloatArray = self.covariance / self.spec.forgetting
        information = np.linalg.inv(covariance) + jacobian.T @ jacobian / variance
        self.covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        # Without excitation, forgetting would increase the covariance beyond the initial one.
        ratio = np.sqrt(np.clip(np.diag(self.prior) / np.diag(self.covariance), None, 1.0))
        self.covariance = np.asarray(self.covariance * np.outer(ratio, ratio), dtype=np.float64)
        step = self.covariance @ (jacobian.T @ innovation) / variance
        self.value = np.clip(self.value + step, *self.bounds)
        return "updated"

    def compare(self, base_rms: float, updated_rms: float) -> None:
        """Fall back to the base if the update has recently predicted worse, or end the fallback."""
        if not (np.isfinite(base_rms) and np.isfinite(updated_rms)):
            return
        now: FloatArray = np.array([base_rms, updated_rms])
        if self.errors is not None:
            now = _MEMORY * self.errors + (1.0 - _MEMORY) * now
        self.errors = now
        self.has_fallback = bool(now[1] > _WORSE * now[0])


def track(
    recursion: Recursion,
    rows: Sequence[Row],
    *,
    disturb: Disturb | None = None,
    base: Realization | None = None,
) -> list[Window]:
    """Predict and update the windows of trials in order of time, until the run must end.

    Args:
        recursion: state of the estimation, which is changed in place.
        rows: trials with the base model and their controllers.
        disturb: fault of the sensors, or None.
        base: the base model; needed where effects beside its MJCF act or are updated.
    """
    found: list[Window] = []
    for row in rows:
        for start, true in _windows(row.trial, recursion.spec.window):
            if skips(f"windows of {row.trial.name} from {start:.3g} s"):
                return found
            seen: Trial | None = true
            if disturb is not None:
                position = disturb(true.time + start, true.position)
                seen = None if position is None else replace(true, position=position)
            if seen is None:
                recursion.restart()
                seen = true
            found.append(_window(recursion, replace(row, trial=seen), true, start, base))
    return found


def _window(
    recursion: Recursion, row: Row, true: Trial, start: float, base: Realization | None
) -> Window:
    seen = row.trial
    if not np.isfinite(seen.position[0]).all():
        # Without an initial state the window is predicted from the undisturbed one, and not used.
        row, learn = replace(row, trial=replace(true)), False
    else:
        learn = True
    low, high = recursion.bounds
    used, steps = recursion.in_use, _STEP * (high - low)
    values = [recursion.base, used, recursion.value]
    for i, step in enumerate(steps):
        moved = recursion.value.copy()
        moved[i] += step if moved[i] + step <= high[i] else -step
        values.append(moved)
    predicted = predicted_positions(row, list(recursion.spec.parameters), values, base)
    base_rms, used_rms = (
        float(np.sqrt(np.nanmean(np.square(p - true.position)))) for p in predicted[:2]
    )
    state = "no position to start from"
    if learn:
        measured = seen.position
        centre = predicted[2]
        columns = [
            ((p - centre) / (v[i] - recursion.value[i])).ravel()
            for i, (p, v) in enumerate(zip(predicted[3:], values[3:], strict=True))
        ]
        share = max(1.0, len(measured) / _INDEPENDENT)
        state = recursion.update(np.array(columns).T, (measured - centre).ravel(), share)
        seen_errors = [float(np.sqrt(np.mean(np.square(p - measured)))) for p in predicted[:3:2]]
        if state == "updated":
            recursion.compare(*seen_errors)
    if state == "updated" and recursion.has_fallback:
        state = "base"
    side = 1.0 * (recursion.value >= high) - 1.0 * (recursion.value <= low)
    return Window(start, base_rms, used_rms, recursion.in_use.copy(), state, side)


def _windows(trial: Trial, length: float) -> list[tuple[float, Trial]]:
    """Start (s) and part of a trial, for each window with a complete first row."""
    found = []
    starts = np.arange(0.0, trial.duration - 0.5 * length, length)
    for start in starts:
        rows = np.flatnonzero((trial.time >= start) & (trial.time < start + length))
        while len(rows) and not np.isfinite(trial.position[rows[0]]).all():
            rows = rows[1:]
        if len(rows) < 2 * _SLOPE_SAMPLES:
            continue
        at = float(trial.time[rows[0]])
        # The window includes the command held at its start and the first one after its end.
        first = max(int(np.searchsorted(trial.command_time, at, side="right")) - 1, 0)
        last = int(np.searchsorted(trial.command_time, trial.time[rows[-1]], side="right")) + 1
        velocity = np.full((len(rows), len(trial.joints)), np.nan)
        velocity[0] = _speed(trial, int(rows[0]))
        part = replace(
            trial,
            start=trial.start + round(1e9 * at),
            time=trial.time[rows] - at,
            position=trial.position[rows],
            velocity=velocity,
            effort=None,
            command_time=trial.command_time[first:last] - at,
            command=trial.command[first:last],
            own_commands=None if trial.own_commands is None else trial.own_commands[first:last],
            marks=(),
            offset=trial.offset + at,
        )
        found.append((at, part))
    return found


def _speed(trial: Trial, row: int) -> FloatArray:
    """(j,) velocity at a row: measured, or else from the slope of the preceding positions."""
    if trial.velocity is not None and np.isfinite(trial.velocity[row]).all():
        measured: FloatArray = trial.velocity[row]
        return measured
    first = max(0, row - _SLOPE_SAMPLES)
    if first == row:
        return np.zeros(len(trial.joints))
    time, position = trial.time[first : row + 1], trial.position[first : row + 1]
    if not np.isfinite(position).all() or np.ptp(time) <= 0.0:
        return np.zeros(len(trial.joints))
    slope: FloatArray = np.polyfit(time - time[-1], position, 1)[0]
    return slope
