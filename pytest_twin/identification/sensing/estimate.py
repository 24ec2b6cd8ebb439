"""A force-torque sensor or an IMU, estimated from recordings, with covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import minimize_scalar
from scipy.stats import t as student

from pytest_twin.arrays import FloatArray
from pytest_twin.identification.sensing.recorded import SensorTrial
from pytest_twin.sensors import force_torque, imu
from pytest_twin.sensors.force_torque import ForceTorqueSensor, limits_of, low_passed
from pytest_twin.sensors.imu import ImuSensor
from pytest_twin.sensors.linear import Linear, fit_linear, in_blocks

_MOST_FILTER_S = 0.1
"""Longest time constant of a sensor's filter that is searched: 1.6 Hz."""
_GROUPS = ((0, 1, 2), (3, 4, 5))


@dataclass(frozen=True)
class SensorEstimate:
    """What was found of one sensor.

    Attributes:
        names: parameters, each with an interval.
        values: (p,) in SI units.
        units: (p,).
        covariance: (p, p).
        quantile: half width of a 95 % interval in standard deviations.
        untold: directions of the true signal that the motion did not excite, in words.
        linear: by group of channels: all six of a force-torque sensor, gyroscope and accelerometer
            of an IMU.
        time_constant: of the filter, s; 0 for an IMU.
        limit: (6,) of the readings, infinite for none.
        nominal, error: (6,) root mean square on the held-out recordings, of an ideal sensor and of
            this one; on the fitted ones where nothing is held out.
    """

    names: tuple[str, ...]
    values: FloatArray
    units: tuple[str, ...]
    covariance: FloatArray
    quantile: float
    untold: tuple[str, ...]
    linear: tuple[Linear, ...]
    time_constant: float
    limit: FloatArray
    nominal: FloatArray
    error: FloatArray


def estimate(fit: Sequence[SensorTrial], held_out: Sequence[SensorTrial]) -> SensorEstimate:
    """Estimate a sensor.

    Readings at the sensor's limit are left out. The filter's time constant of a force-torque sensor
    is that of the least residual; the other parameters are linear given it. Its covariance is that
    of the linearized problem.

    Args:
        fit, held_out: recordings of one sensor.
    """
    inertial = fit[0].inertial
    axes = imu.AXES if inertial else force_torque.AXES
    groups = _GROUPS if inertial else ((0, 1, 2, 3, 4, 5),)
    limit = limits_of(np.vstack([one.reading for one in fit]))
    keep = [np.all(np.abs(one.reading) < limit * (1.0 - 1e-9), axis=1) for one in fit]
    blocks = np.concatenate([np.array(in_blocks([len(one.reading) for one in fit]))])[
        np.concatenate(keep)
    ].tolist()
    blocks = np.unique(blocks, return_inverse=True)[1].tolist()
    reading = np.vstack([one.smoothed[rows] for one, rows in zip(fit, keep, strict=True)])

    def true_at(time_constant: float) -> FloatArray:
        rows = zip(fit, keep, strict=True)
        return np.vstack([low_passed(one.true, time_constant, one.period)[k] for one, k in rows])

    def solved(time_constant: float) -> list[Linear]:
        true = true_at(time_constant)
        return [
            fit_linear(true[:, group], reading[:, group], blocks, np.eye(len(group)))
            for group in groups
        ]

    slow = 0.0 if inertial else _filter(solved)
    found = solved(slow)
    names, values, units, covariance = _flat(found, groups, axes)
    if slow > 0.0:
        deviation = _filter_deviation(true_at, slow, found[0], reading, blocks)
        names.append("sensor_filter_time")
        units.append("s")
        values = np.append(values, slow)
        covariance = np.block(
            [[covariance, np.zeros((len(covariance), 1))],
             [np.zeros((1, len(covariance))), np.array([[deviation**2]])]]
        )  # fmt: skip
    tested = held_out or fit
    nominal = _rms([one.smoothed - one.true for one in tested])
    error = _rms([one.smoothed - _predicted(one, found, slow) for one in tested])
    return SensorEstimate(
        tuple(names), values, tuple(units), covariance,
        float(student.ppf(0.975, max(1, found[0].blocks - 1))),
        tuple(_untold(found, groups, axes)), tuple(found), slow, limit, nominal, error,
    )  # fmt: skip


def _predicted(trial: SensorTrial, found: Sequence[Linear], slow: float) -> FloatArray:
    """What the estimated sensor reads, within its limits."""
    if trial.inertial:
        turning, pushing = found
        return ImuSensor(turning.matrix, turning.bias, pushing.matrix, pushing.bias).measured(
            trial.true
        )
    (one,) = found
    unlimited = np.full(6, np.inf)
    return ForceTorqueSensor(one.bias, one.matrix, slow, unlimited).measured(
        trial.true, trial.period
    )


def _rms(errors: Sequence[FloatArray]) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(np.vstack(errors) ** 2, axis=0)))


def _filter(solved: Callable[[float], list[Linear]]) -> float:
    """Time constant of the least residual, each channel over its own; 0 where none is better."""
    base = solved(0.0)[0].residual
    weight = np.where(base > 0.0, base, 1.0)

    def cost(time_constant: float) -> float:
        return float(np.mean((solved(time_constant)[0].residual / weight) ** 2))

    grid = np.geomspace(1e-4, _MOST_FILTER_S, 16)
    costs = [cost(float(one)) for one in grid]
    at = int(np.argmin(costs))
    low, high = grid[max(0, at - 1)], grid[min(len(grid) - 1, at + 1)]
    best = minimize_scalar(cost, bounds=(low, high), method="bounded", options={"xatol": 1e-6})
    return float(best.x) if best.fun < 0.999 else 0.0


def _filter_deviation(
    true_at: Callable[[float], FloatArray],
    slow: float,
    linear: Linear,
    reading: FloatArray,
    blocks: Sequence[int],
) -> float:
    """Standard deviation of the time constant beside the linear parameters."""
    step = 0.02 * slow
    true = true_at(slow)
    change = (true_at(slow + step) - true_at(slow - step)) / (2.0 * step)
    design = np.hstack([true, np.ones((len(true), 1))])
    slope = change @ linear.matrix.T
    slope = slope - design @ np.linalg.lstsq(design, slope, rcond=None)[0]
    errors = reading - linear.measured(true)
    weight = 1.0 / np.maximum(linear.residual, 1e-300) ** 2
    information = float(np.sum(slope**2 * weight))
    scores = np.sum(slope * errors * weight, axis=1)
    number = np.array(blocks)
    count = int(number.max()) + 1
    sums = np.array([scores[number == block].sum() for block in range(count)])
    return float(np.sqrt(count / (count - 1) * np.sum(sums**2)) / max(information, 1e-300))


def _flat(
    found: Sequence[Linear], groups: Sequence[tuple[int, ...]], axes: Sequence[str]
) -> tuple[list[str], FloatArray, list[str], FloatArray]:
    """Parameters of all channels, and their covariance: channels err on their own."""
    names: list[str] = []
    values: list[float] = []
    units: list[str] = []
    parts: list[FloatArray] = []
    for one, group in zip(found, groups, strict=True):
        reached = _reached(one)
        for row, channel in enumerate(group):
            keep = [*np.flatnonzero(reached[:-1]).tolist(), *([len(group)] if reached[-1] else [])]
            parts.append(one.covariance[row][np.ix_(keep, keep)])
            for column in keep:
                if column == len(group):
                    names.append(f"sensor_bias_{axes[channel]}")
                    values.append(float(one.bias[row]))
                    units.append(_unit(axes[channel]))
                    continue
                kind = "scale" if column == row else "coupling"
                source = "" if column == row else f"_{axes[group[column]]}"
                names.append(f"sensor_{kind}_{axes[channel]}{source}")
                values.append(float(one.matrix[row, column]))
                units.append(_ratio(_unit(axes[channel]), _unit(axes[group[column]])))
    covariance: FloatArray = block_diag(*parts)
    return names, np.array(values), units, covariance


def _reached(one: Linear) -> FloatArray:
    """(m + 1,) whether a channel of the true signal, or the bias, has no part in what is untold."""
    reached = np.ones(one.matrix.shape[1] + 1, dtype=bool)
    for direction in one.untold:
        reached &= np.abs(direction) < 0.05
    return reached


def _untold(
    found: Sequence[Linear], groups: Sequence[tuple[int, ...]], axes: Sequence[str]
) -> list[str]:
    words = []
    for one, group in zip(found, groups, strict=True):
        names = [*(axes[channel] for channel in group), "bias"]
        for direction in one.untold:
            terms = [
                f"{share:+.2f} {name}"
                for share, name in zip(direction, names, strict=True)
                if abs(share) >= 0.05
            ]
            words.append(" ".join(terms))
    return words


def _unit(axis: str) -> str:
    return {"f": "N", "t": "N*m", "g": "rad/s", "a": "m/s^2"}[axis[0]]


def _ratio(over: str, under: str) -> str:
    if over == under:
        return "1"
    return {("N", "N*m"): "1/m", ("N*m", "N"): "m"}[over, under]
