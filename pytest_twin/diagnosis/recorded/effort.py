"""Whether a logged effort is what the controller demanded or what a sensor measured, and how late.

A demanded effort obeys the servo's law on the measured state whatever the drive makes of it: it
shows no lag and no dead zone, and as evidence of a sensor it would deny both. An effort of another
instant than its message's positions looks like a lag of the drive.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.recorded.effort_settings import EFFORTS
from pytest_twin.diagnosis.recorded.fact import Fact, unknown
from pytest_twin.diagnosis.smoothing import derivatives
from pytest_twin.recording_options import CommandMode
from pytest_twin.trial.setpoint import Setpoint

# Share of the efforts' deviation below which a difference is rounding.
_NEGLIGIBLE = 1e-6


@dataclass(frozen=True, slots=True)
class Law:
    """How well a law explains efforts.

    Attributes:
        left: deviation of what it leaves, N*m or N; the largest tenth, beside jumps, is left out.
        older: s by which the effort is older than its stamp.
        at_once: deviation where it is not older.
    """

    left: float
    older: float
    at_once: float


@dataclass(frozen=True, slots=True)
class Signals:
    """One joint's log, on a fine grid.

    Attributes:
        time: (n,) s of the samples.
        effort: (n,) N*m or N.
        grid: (m,) s.
        error: (m,) setpoint less position, or the commanded effort.
        speed: (m,) rad/s or m/s; None under effort commands.
    """

    time: FloatArray
    effort: FloatArray
    grid: FloatArray
    error: FloatArray
    speed: FloatArray | None


def signals(
    time: FloatArray,
    position: FloatArray,
    velocity: FloatArray | None,
    effort: FloatArray,
    setpoint: Setpoint,
    joint: int,
    *,
    mode: CommandMode,
) -> Signals | None:
    """What the laws need of one joint.

    Positions and velocities are smoothed alike, whatever time they are asked at: else a time
    between two samples would seem to fit better, by their noise alone.

    Args:
        time: (n,) s.
        position, velocity, effort: (n,) of the joint; finite.
        setpoint: what is commanded.
        joint: column of the setpoint.
        mode: of the command.

    Returns:
        None where there are too few samples.
    """
    if len(time) < EFFORTS.fewest_samples:
        return None
    period = float(np.median(np.diff(time)))
    grid = np.arange(time[0], time[-1], period / EFFORTS.fine)
    asked = setpoint.at(grid)[:, joint]
    if mode == "effort":
        return Signals(time, effort, grid, asked, None)
    smooth, slope, _ = derivatives(time, position[:, None], EFFORTS.smooth * period)
    if velocity is not None:
        slope, _, _ = derivatives(time, velocity[:, None], EFFORTS.smooth * period)
    speed = np.interp(grid, time, slope[:, 0])
    if mode == "velocity":
        return Signals(time, effort, grid, asked - speed, speed)
    at = CubicSpline(time, smooth[:, 0])(grid)
    return Signals(time, effort, grid, asked - at, speed)


def pooled(laws: Sequence[Law]) -> Law:
    """One law over several recordings: geometric means of deviations, the median offset."""
    left, at_once = (
        float(np.exp(np.mean(np.log(np.maximum(values, 1e-300)))))
        for values in ([x.left for x in laws], [x.at_once for x in laws])
    )
    return Law(left, float(np.median([x.older for x in laws])), at_once)


def law(log: Signals, lag: float = 0.0, dead_zone: float = 0.0) -> Law:
    """How well the controller's law on the measured state explains the efforts, its gains free.

    Args:
        log: of the joint.
        lag: s, time constant of the drive; without one it is the demand itself.
        dead_zone: rad or m, half width, of the error.
    """
    error = log.error - np.clip(log.error, -dead_zone, dead_zone)
    columns = [error] if log.speed is None else [error, log.speed]
    step = log.grid[1] - log.grid[0]
    columns = [_lagged(c, lag, step) for c in columns]
    period = EFFORTS.fine * step
    inner = slice(2, -2)
    tried = []
    for older in np.linspace(-EFFORTS.reach, EFFORTS.reach, 2 * EFFORTS.parts + 1) * period:
        then = [np.interp(log.time - older, log.grid, c) for c in columns]
        table = np.stack([*then, np.ones(len(log.time))], axis=1)
        tried.append((_left(log.effort[inner], table[inner]), float(older)))
    # Between two steps of a held command all offsets fit alike: the least of them is claimed.
    alike = EFFORTS.alike * max(min(tried)[0], _NEGLIGIBLE * float(np.std(log.effort)))
    left, older = min((t for t in tried if t[0] <= alike), key=lambda each: abs(each[1]))
    at_once = min(tried, key=lambda each: abs(each[1]))[0]
    return Law(left, older, at_once)


def _lagged(values: FloatArray, lag: float, step: float) -> FloatArray:
    """Values behind a first-order lag, settled at the start."""
    if lag <= step:
        return values
    keep = float(np.exp(-step / lag))
    out: FloatArray = lfilter([1.0 - keep], [1.0, -keep], values, zi=[keep * values[0]])[0]
    return out


def is_the_command(log: Signals) -> bool:
    """Whether efforts of an effort drive are the commanded ones, to within their noise.

    A drive that computes its effort from the current and the nominal motor constant logs the
    command, whatever reaches the joint: as evidence of a sensor it would deny any error of the
    motor constant. A sensor behind a perfect drive reads the same and adds nothing to the command.
    """
    inner = slice(2, -2)
    command = np.interp(log.time, log.grid, log.error)[inner]
    effort = log.effort[inner]
    near = np.abs(effort - command) <= 3.0 * max(_deviation(effort - command), 1e-12)
    table = np.stack([command[near], np.ones(int(near.sum()))], axis=1)
    (gain, offset), *_ = np.linalg.lstsq(table, effort[near], rcond=None)
    off = effort[near] - table @ np.array([gain, offset])
    left, spread = _deviation(off), float(np.std(command[near]))
    # What differs from sample to sample is noise; a lag or a dead zone differs for longer.
    noise = _deviation(np.diff(off)) / np.sqrt(2.0)
    if spread == 0.0 or left > EFFORTS.explains * spread or left > EFFORTS.ahead * noise:
        return False
    deviation = left / spread / np.sqrt(len(command))
    return bool(
        abs(gain - 1.0) <= max(3.0 * deviation, EFFORTS.equal)
        and abs(offset) <= max(3.0 * deviation, EFFORTS.equal) * spread
    )


def effort_fact(scale: float, demands: Sequence[Law], drives: Sequence[Law], period: float) -> Fact:
    """What a logged effort is.

    Args:
        scale: N*m or N, usual deviation of the efforts.
        demands: the controller's law on the measured states, for each thing that commands may do
            between stamps.
        drives: the same behind the drive that explains the motion; empty where none is known, or
            where that drive changes nothing.
        period: s, of the samples.
    """
    laws = {"demanded": tuple(demands), "measured": tuple(drives)}
    best = {name: min(x.left for x in each) for name, each in laws.items() if each}
    name = min(best, key=lambda n: best[n], default=None)
    if name is None or best[name] > EFFORTS.explains * scale:
        return unknown("the controller's law on the measured states does not explain the efforts")
    older = _older([x for x in laws[name] if x.left <= EFFORTS.alike * best[name]], period)
    numbers = {"lag": (older, "s")}
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
    if older:
        side = "older" if older > 0.0 else "younger"
        words += (
            f"; the effort is {1e3 * abs(older):.3g} ms {side} than the positions of its message"
        )
    if len(best) < 2 or max(best.values()) < EFFORTS.ahead * best[name]:
        return Fact(None, 0.0, "data", words, numbers)
    return Fact(name, 0.99, "data", words, numbers)


def _older(laws: Sequence[Law], period: float) -> float:
    """s by which an effort is older than its stamp, the least of the laws that explain it alike; 0
    where some needs none.
    """
    late = [
        x.older
        if abs(x.older) > EFFORTS.late * period and x.left < EFFORTS.less * x.at_once
        else 0.0
        for x in laws
    ]
    return min(late, key=abs, default=0.0)


def _left(effort: FloatArray, columns: FloatArray) -> float:
    """Deviation of what a law with free gains leaves; a second fit heeds no jumps."""
    weights, *_ = np.linalg.lstsq(columns, effort, rcond=None)
    off = effort - columns @ weights
    near = np.abs(off) <= 3.0 * max(_deviation(off), 1e-12)
    if near.sum() > 2 * columns.shape[1]:
        weights, *_ = np.linalg.lstsq(columns[near], effort[near], rcond=None)
    return _deviation(effort - columns @ weights)


def _deviation(values: FloatArray) -> float:
    """Root mean square of the smallest nine tenths: a sample beside a jump counts little."""
    square = np.sort(values**2)
    return float(np.sqrt(np.mean(square[: max(round(EFFORTS.kept * len(square)), 1)])))
