"""Bounded recursive least squares over named parameters, one window of motion after another.

The prediction of a window starts at its first measured state; its error over the window, to first
order in the parameters, is the innovation. The recursion is the recursive prediction error method
with forgetting (Ljung, "System Identification", 2nd ed., 1999, ch. 11), projected onto the bounds.
Each window is predicted before its own measurements update anything.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

from pytest_twin.adaptation_spec import UpdateSpec
from pytest_twin.arrays import FloatArray
from pytest_twin.errors import SpecError
from pytest_twin.replay import Row, replay_rows
from pytest_twin.trial import Trial

_FIELDS = {
    "viscous_friction": "dof_damping",
    "coulomb_friction": "dof_frictionloss",
    "armature": "dof_armature",
}
_INDEPENDENT = 10.0
"""Samples of one window and joint that count as independent: neighbours share the model's error."""
_STEP = 1e-3
"""Finite-difference step, as a share of the width of the bounds."""
_OUTLIER = 4.0
"""An innovation this many times the usual one is a fault and updates nothing."""
_MEMORY = 0.8
"""Weight of the past in the running errors of base and update."""
_WORSE = 1.02
"""Ratio of the running errors from which on the base predicts again."""
_SLOPE_SAMPLES = 5

Disturb = Callable[[FloatArray, FloatArray], "FloatArray | None"]
"""(times in s, measured positions (n, j)) of a window to what the sensors make of it; None where
the process restarts."""


@dataclass(frozen=True, slots=True)
class Window:
    """One window of motion.

    Attributes:
        start: s from the trial's first state.
        base_rms, updated_rms: error of the prediction by the base's parameters and by those that
            were in use, rad or m, against what was truly measured.
        parameters: those in use after the window.
        state: ``updated``, ``base`` (fallback; the recursion went on), or why nothing was updated.
    """

    start: float
    base_rms: float
    updated_rms: float
    parameters: FloatArray
    state: str


@dataclass(slots=True)
class Recursion:
    """The state of the update.

    Attributes:
        spec: its declaration.
        base: (p,) the base model's parameters.
        value, covariance: (p,) and (p, p) the estimate.
        has_fallback: whether the base's parameters are in use.
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
        """(p,) lower and upper."""
        low, high = np.array(list(self.spec.parameters.values())).T
        return low, high

    @property
    def prior(self) -> FloatArray:
        """(p, p) covariance at the start: a quarter of the bounds' width is one deviation."""
        low, high = self.bounds
        return np.diag(((high - low) / 4.0) ** 2)

    @property
    def in_use(self) -> FloatArray:
        """(p,) what predicts the next window."""
        return self.base if self.has_fallback else self.value

    def restart(self) -> None:
        """Forget everything but the declaration and the base."""
        self.value, self.covariance = self.base.copy(), self.prior
        self.has_fallback, self.usual, self.errors = False, None, None

    def update(self, jacobian: FloatArray, innovation: FloatArray, share: float) -> str:
        """Take one window in.

        Args:
            jacobian: (m, p) of the predictions at ``value``.
            innovation: (m,) measured less predicted at ``value``, rad or m.
            share: variance of a sample relative to that of an independent one.

        Returns:
            ``updated``, or why not.
        """
        if not (np.isfinite(jacobian).all() and np.isfinite(innovation).all()):
            return "no finite measurement"
        size = float(np.sqrt(np.mean(np.square(innovation))))
        if self.usual is not None and size > _OUTLIER * max(self.usual, self.spec.noise):
            return "the error is not of the usual size"
        self.usual = size if self.usual is None else 0.8 * self.usual + 0.2 * size
        # The model's error is noise to the update too.
        variance = share * max(self.spec.noise, size) ** 2
        covariance: FloatArray = self.covariance / self.spec.forgetting
        information = np.linalg.inv(covariance) + jacobian.T @ jacobian / variance
        self.covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        # Without excitation forgetting alone would let it grow beyond what was known at the start.
        ratio = np.sqrt(np.clip(np.diag(self.prior) / np.diag(self.covariance), None, 1.0))
        self.covariance = np.asarray(self.covariance * np.outer(ratio, ratio), dtype=np.float64)
        step = self.covariance @ (jacobian.T @ innovation) / variance
        self.value = np.clip(self.value + step, *self.bounds)
        return "updated"

    def compare(self, base_rms: float, updated_rms: float) -> None:
        """Fall back to the base where the update has lately predicted worse, or return from it."""
        if not (np.isfinite(base_rms) and np.isfinite(updated_rms)):
            return
        now: FloatArray = np.array([base_rms, updated_rms])
        if self.errors is not None:
            now = _MEMORY * self.errors + (1.0 - _MEMORY) * now
        self.errors = now
        self.has_fallback = bool(now[1] > _WORSE * now[0])


def base_parameters(spec: UpdateSpec, model: mujoco.MjModel) -> FloatArray:
    """(p,) what a model has, SI units at the joint.

    Raises:
        SpecError: a joint that the model lacks, or a value outside its bounds.
    """
    found = []
    for name, (low, high) in spec.parameters.items():
        attribute, dof = _place(name, model)
        value = float(getattr(model, attribute)[dof])
        if not low <= value <= high:
            raise SpecError(
                "the base model's value lies outside the bounds of the update",
                where=f"update.parameters.{name}",
                value=value,
                expected=f"bounds around it, not {low:g} to {high:g}",
            )
        found.append(value)
    return np.array(found)


def track(
    recursion: Recursion, rows: Sequence[Row], *, disturb: Disturb | None = None
) -> list[Window]:
    """Predict and update window by window through trials in their order.

    Args:
        recursion: its state, which is changed.
        rows: trials with the base model under their controllers.
        disturb: a fault of the sensors; nothing if None.
    """
    found: list[Window] = []
    for row in rows:
        for start, true in _windows(row.trial, recursion.spec.window):
            seen: Trial | None = true
            if disturb is not None:
                position = disturb(true.time + start, true.position)
                seen = None if position is None else replace(true, position=position)
            if seen is None:
                recursion.restart()
                seen = true
            found.append(_window(recursion, replace(row, trial=seen), true, start))
    return found


def _window(recursion: Recursion, row: Row, true: Trial, start: float) -> Window:
    seen = row.trial
    if not np.isfinite(seen.position[0]).all():
        # Nowhere to start from: predicted from what is known to be true, and not learned from.
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
    names = list(recursion.spec.parameters)
    predicted = [
        one.position
        for one in replay_rows(
            [replace(row, model=_with(row.model, names, value)) for value in values], threads=1
        )
    ]
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
    return Window(start, base_rms, used_rms, recursion.in_use.copy(), state)


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
        # With the command that holds at the start, and the one after the end.
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
    """(j,) velocity at a row: as measured, else the slope of the positions up to it."""
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


def _place(name: str, model: mujoco.MjModel) -> tuple[str, int]:
    joint, _, parameter = name.rpartition(".")
    index = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint))
    if index < 0:
        raise SpecError(
            "no such joint", where=f"update.parameters.{name}", value=joint,
            expected="a joint of the model",
        )  # fmt: skip
    return _FIELDS[parameter], int(model.jnt_dofadr[index])


def _with(model: mujoco.MjModel, names: Sequence[str], values: FloatArray) -> mujoco.MjModel:
    changed = copy.copy(model)
    for name, value in zip(names, values, strict=True):
        attribute, dof = _place(name, model)
        getattr(changed, attribute)[dof] = value
    return changed
