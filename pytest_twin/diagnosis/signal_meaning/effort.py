"""Origin of a logged effort (demanded by the controller or measured by a sensor) and its age.

A demanded effort follows the control law on the measured state and does not show what the drive
does. Taken for a measurement it would exclude a lag or dead zone of the drive. An effort that is
older than the positions of its message looks like a lag of the drive.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.signal_meaning.effort_settings import EFFORTS
from pytest_twin.diagnosis.signal_meaning.fact import Fact, unknown
from pytest_twin.diagnosis.smoothing import derivatives
from pytest_twin.recording_options import CommandMode
from pytest_twin.trial.setpoint import Setpoint

# Share of the efforts' standard deviation below which a difference is a rounding error.
_NEGLIGIBLE = 1e-6


@dataclass(frozen=True, slots=True)
class LawFit:
    """How well a law explains efforts.

    Attributes:
        rms: RMS residual without its largest tenth (samples next to jumps), N*m or N.
        age: age of the effort relative to its stamp, s.
        rms_without_age: the same residual if the effort has no age.
    """

    rms: float
    age: float
    rms_without_age: float


@dataclass(frozen=True, slots=True)
class JointLog:
    """Log of one joint, with the inputs of the control law on a fine time grid.

    Attributes:
        time: (n,) times of the samples, s.
        effort: (n,) logged efforts, N*m or N.
        grid: (m,) times of the grid, s.
        error: (m,) setpoint minus measured value, or the commanded effort.
        speed: (m,) velocity, rad/s or m/s; None under effort commands.
    """

    time: FloatArray
    effort: FloatArray
    grid: FloatArray
    error: FloatArray
    speed: FloatArray | None


def build_joint_log(
    time: FloatArray,
    position: FloatArray,
    velocity: FloatArray | None,
    effort: FloatArray,
    setpoint: Setpoint,
    joint: int,
    *,
    mode: CommandMode,
) -> JointLog | None:
    """Log of one joint for :func:`fit_control_law`; None if there are too few samples.

    Positions and velocities are smoothed equally at all times of the grid. Otherwise times between
    samples would fit better because interpolation reduces noise there.

    Args:
        time: (n,) times of the samples, s.
        position, velocity, effort: (n,) values of the joint, finite.
        joint: column of the joint in ``setpoint``.
    """
    if len(time) < EFFORTS.fewest_samples:
        return None
    period = float(np.median(np.diff(time)))
    grid = np.arange(time[0], time[-1], period / EFFORTS.fine)
    setpoints = setpoint.at(grid)[:, joint]
    if mode == "effort":
        return JointLog(time, effort, grid, setpoints, None)
    smooth, slope, _ = derivatives(time, position[:, None], EFFORTS.smooth * period)
    if velocity is not None:
        slope, _, _ = derivatives(time, velocity[:, None], EFFORTS.smooth * period)
    speed = np.interp(grid, time, slope[:, 0])
    if mode == "velocity":
        return JointLog(time, effort, grid, setpoints - speed, speed)
    at = CubicSpline(time, smooth[:, 0])(grid)
    return JointLog(time, effort, grid, setpoints - at, speed)


def pool_recordings(laws: Sequence[LawFit]) -> LawFit:
    """One law for several recordings: geometric means of the residuals, median of the ages."""
    rms, rms_without_age = (
        float(np.exp(np.mean(np.log(np.maximum(values, 1e-300)))))
        for values in ([x.rms for x in laws], [x.rms_without_age for x in laws])
    )
    return LawFit(rms, float(np.median([x.age for x in laws])), rms_without_age)


def fit_control_law(log: JointLog, lag: float = 0.0, dead_zone: float = 0.0) -> LawFit:
    """How well the control law on the measured state explains the efforts, with fitted gains.

    Args:
        lag: time constant of the drive, s; 0 for the demanded effort.
        dead_zone: half width of the dead zone of the error, rad or m.
    """
    error = log.error - np.clip(log.error, -dead_zone, dead_zone)
    columns = [error] if log.speed is None else [error, log.speed]
    step = log.grid[1] - log.grid[0]
    columns = [_apply_lag(c, lag, step) for c in columns]
    period = EFFORTS.fine * step
    inner = slice(2, -2)
    tried = []
    for age in np.linspace(-EFFORTS.reach, EFFORTS.reach, 2 * EFFORTS.parts + 1) * period:
        then = [np.interp(log.time - age, log.grid, c) for c in columns]
        table = np.stack([*then, np.ones(len(log.time))], axis=1)
        tried.append((_residual_rms(log.effort[inner], table[inner]), float(age)))
    # Between two steps of a held command all ages fit equally well; the smallest one is reported.
    alike = EFFORTS.alike * max(min(tried)[0], _NEGLIGIBLE * float(np.std(log.effort)))
    rms, age = min((t for t in tried if t[0] <= alike), key=lambda each: abs(each[1]))
    rms_without_age = min(tried, key=lambda each: abs(each[1]))[0]
    return LawFit(rms, age, rms_without_age)


def _apply_lag(values: FloatArray, lag: float, step: float) -> FloatArray:
    """Values after a first-order lag of ``lag`` s, in equilibrium at the start."""
    if lag <= step:
        return values
    from scipy.signal import lfilter

    keep = float(np.exp(-step / lag))
    out: FloatArray = lfilter([1.0 - keep], [1.0, -keep], values, zi=[keep * values[0]])[0]
    return out


def equals_command(log: JointLog) -> bool:
    """Whether the logged efforts of an effort drive equal its commands, to within their noise.

    A drive that computes the effort from current and nominal motor constant logs the command. Taken
    for a measurement it would exclude any error of the motor constant. A sensor behind a perfect
    drive reads the same and adds no information.
    """
    inner = slice(2, -2)
    command = np.interp(log.time, log.grid, log.error)[inner]
    effort = log.effort[inner]
    near = np.abs(effort - command) <= 3.0 * max(_deviation(effort - command), 1e-12)
    table = np.stack([command[near], np.ones(int(near.sum()))], axis=1)
    (gain, offset), *_ = np.linalg.lstsq(table, effort[near], rcond=None)
    off = effort[near] - table @ np.array([gain, offset])
    rms, spread = _deviation(off), float(np.std(command[near]))
    # Noise is independent from sample to sample; the error of a lag or dead zone lasts longer.
    noise = _deviation(np.diff(off)) / np.sqrt(2.0)
    if spread == 0.0 or rms > EFFORTS.explains * spread or rms > EFFORTS.ahead * noise:
        return False
    deviation = rms / spread / np.sqrt(len(command))
    return bool(
        abs(gain - 1.0) <= max(3.0 * deviation, EFFORTS.equal)
        and abs(offset) <= max(3.0 * deviation, EFFORTS.equal) * spread
    )


def effort_fact(
    scale: float, demands: Sequence[LawFit], drives: Sequence[LawFit], period: float
) -> Fact:
    """Origin and age of a logged effort.

    Args:
        scale: standard deviation of the efforts, N*m or N.
        demands: the control law on the measured states, for each possible interpolation of the
            commands.
        drives: the same with the drive that explains the motion; empty if there is none.
        period: sample period, s.
    """
    laws = {"demanded": tuple(demands), "measured": tuple(drives)}
    best = {name: min(x.rms for x in each) for name, each in laws.items() if each}
    name = min(best, key=lambda n: best[n], default=None)
    if name is None or best[name] > EFFORTS.explains * scale:
        return unknown("the controller's law on the measured states does not explain the efforts")
    age = _reported_age([x for x in laws[name] if x.rms <= EFFORTS.alike * best[name]], period)
    numbers = {"lag": (age, "s")}
    unit = f"their own deviation {scale:.3g}, N*m or N"
    words = (
        "the controller's law on the measured states explains the logged efforts to "
        f"{best[name]:.3g} ({unit})"
    )
    if len(best) == 2:
        words = (
            f"deviation of the logged efforts if they are demanded: {best['demanded']:.3g}, if a "
            f"sensor measures them behind the drive that explains the motion: "
            f"{best['measured']:.3g} ({unit})"
        )
    if age:
        side = "older" if age > 0.0 else "younger"
        words += f"; the effort is {1e3 * abs(age):.3g} ms {side} than the positions of its message"
    if len(best) < 2 or max(best.values()) < EFFORTS.ahead * best[name]:
        return Fact(None, 0.0, "data", words, numbers)
    return Fact(name, 0.99, "data", words, numbers)


def _reported_age(laws: Sequence[LawFit], period: float) -> float:
    """Age of an effort relative to its stamp in s, the smallest among equally good laws.

    It is 0 if a law explains the effort without an age.
    """
    late = [
        x.age
        if abs(x.age) > EFFORTS.late * period and x.rms < EFFORTS.less * x.rms_without_age
        else 0.0
        for x in laws
    ]
    return min(late, key=abs, default=0.0)


def _residual_rms(effort: FloatArray, columns: FloatArray) -> float:
    """RMS residual of a law with fitted gains; a second fit leaves out samples next to jumps."""
    weights, *_ = np.linalg.lstsq(columns, effort, rcond=None)
    off = effort - columns @ weights
    near = np.abs(off) <= 3.0 * max(_deviation(off), 1e-12)
    if near.sum() > 2 * columns.shape[1]:
        weights, *_ = np.linalg.lstsq(columns[near], effort[near], rcond=None)
    return _deviation(effort - columns @ weights)


def _deviation(values: FloatArray) -> float:
    """Root mean square of the smallest nine tenths, without samples next to jumps."""
    square = np.sort(values**2)
    return float(np.sqrt(np.mean(square[: max(round(EFFORTS.kept * len(square)), 1)])))
