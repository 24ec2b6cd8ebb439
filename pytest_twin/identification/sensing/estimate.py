"""Estimate sensors that are linear in the true signal, and camera delays, with covariance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import minimize_scalar
from scipy.stats import t as student

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.timing import SensorDelay
from pytest_twin.formats.sensor_record import CAMERA, GROUPS, IMU, sensor_fields
from pytest_twin.identification.sensing.camera_frames import CameraTrial, delay_of, turn_errors
from pytest_twin.identification.sensing.sensor_recordings import SensorTrial
from pytest_twin.sensors.force_torque import limits_of, low_passed
from pytest_twin.sensors.identified_sensors import axes_of, readings_of, unit_of
from pytest_twin.sensors.linear import Linear, fit_linear, in_blocks

_MOST_FILTER_S = 0.1
"""Longest time constant of a sensor's filter (cutoff 1.6 Hz)."""


@dataclass(frozen=True)
class SensorEstimate:
    """Estimated parameters of one sensor.

    Attributes:
        axes: names of its axes.
        values: (p,) values in SI units.
        units: (p,) units.
        covariance: (p, p) covariance.
        quantile: (p,) half widths of the 95 % intervals in standard deviations.
        undetermined: descriptions of signal directions that the motion did not excite.
        fields: sensor model for a simulation, in the form of ``sensors:`` of a record.
        nominal, error: (k,) RMS errors of an ideal sensor and of this sensor on the held-out
            recordings, or on the fitted ones if nothing is held out.
    """

    kind: str
    axes: tuple[str, ...]
    axis_units: tuple[str, ...]
    names: tuple[str, ...]
    values: FloatArray
    units: tuple[str, ...]
    covariance: FloatArray
    quantile: FloatArray
    undetermined: tuple[str, ...]
    fields: Mapping[str, Any]
    nominal: FloatArray
    error: FloatArray


def estimate(fit: Sequence[SensorTrial], held_out: Sequence[SensorTrial]) -> SensorEstimate:
    """Estimate a sensor.

    Saturated readings are left out. The filter time constant of a force-torque sensor minimizes the
    residual; for a given time constant the other parameters are linear. The covariance is that of
    the linearized problem.
    """
    kind = fit[0].kind
    axes = axes_of(kind, fit[0].is_slide)
    groups = _groups(kind)
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

    slow = 0.0 if kind == IMU else _filter(solved)
    found = solved(slow)
    names, values, units, covariance, freedom = _flatten(found, groups, axes)
    if slow > 0.0:
        deviation = _filter_deviation(true_at, slow, found[0], reading, blocks)
        names.append("sensor_filter_time")
        units.append("s")
        values, freedom = np.append(values, slow), np.append(freedom, max(blocks))
        covariance = np.block(
            [[covariance, np.zeros((len(covariance), 1))],
             [np.zeros((1, len(covariance))), np.array([[deviation**2]])]]
        )  # fmt: skip
    fields = {
        "kind": kind,
        "matrix": [one.matrix.tolist() for one in found],
        "bias": [one.bias.tolist() for one in found],
        "time_constant": slow,
        "limit": [float(v) if np.isfinite(v) else None for v in limit],
    }
    unlimited = sensor_fields(
        "", {**fields, "topic": "-", "frame": "-", "limit": [None] * len(axes)}
    )
    tested = held_out or fit
    nominal = _rms([one.smoothed - one.true for one in tested])
    error = _rms([one.smoothed - readings_of(unlimited, one.true, one.period) for one in tested])
    return SensorEstimate(
        kind, axes, tuple(unit_of(axis) for axis in axes),
        tuple(names), values, tuple(units), covariance,
        np.asarray(student.ppf(0.975, freedom)),
        tuple(_undetermined_parameters(found, groups, axes)), fields, nominal, error,
    )  # fmt: skip


def estimate_camera(fit: Sequence[CameraTrial], held_out: Sequence[CameraTrial]) -> SensorEstimate:
    """Estimate the delay of a camera's frames.

    Raises:
        RecordingError: the target does not rotate with the frame.
    """
    found = delay_of(fit)
    timing = found.timing
    tested = held_out or fit
    fields = {
        "kind": CAMERA, "delay": timing.delay, "period": timing.period, "jitter": timing.jitter,
        "lost": timing.lost, "mount": found.mount,
    }  # fmt: skip
    return SensorEstimate(
        CAMERA, ("turn",), ("rad",), (SensorDelay.id,), np.array([timing.delay]), ("s",),
        np.array([[found.deviation**2]]),
        np.asarray(student.ppf(0.975, [max(1, found.blocks - 1)])), (),
        fields,
        np.array([turn_errors(tested, 0.0, found.mount)]),
        np.array([turn_errors(tested, timing.delay, found.mount)]),
    )  # fmt: skip


def _groups(kind: str) -> list[tuple[int, ...]]:
    """Return the channels of each block that is linear in its part of the true signal."""
    found, first = [], 0
    for size in GROUPS[kind]:
        found.append(tuple(range(first, first + size)))
        first += size
    return found


def _rms(errors: Sequence[FloatArray]) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(np.vstack(errors) ** 2, axis=0)))


def _filter(solved: Callable[[float], list[Linear]]) -> float:
    """Return the time constant with the smallest normalized residual; 0 if no filter is better."""
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
    """Return the standard deviation of the time constant, estimated with the linear parameters."""
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


def _flatten(
    found: Sequence[Linear], groups: Sequence[tuple[int, ...]], axes: Sequence[str]
) -> tuple[list[str], FloatArray, list[str], FloatArray, FloatArray]:
    """Return names, values and units of the parameters of all channels, and their uncertainty.

    The latter is their covariance, for independent channels, and its degrees of freedom.
    """
    names: list[str] = []
    values: list[float] = []
    units: list[str] = []
    parts: list[FloatArray] = []
    freedom: list[float] = []
    for one, group in zip(found, groups, strict=True):
        reached = _determined_channels(one)
        for row, channel in enumerate(group):
            keep = [*np.flatnonzero(reached[:-1]).tolist(), *([len(group)] if reached[-1] else [])]
            parts.append(one.covariance[row][np.ix_(keep, keep)])
            freedom += one.freedom[keep].tolist()
            for column in keep:
                if column == len(group):
                    names.append(f"sensor_bias_{axes[channel]}")
                    values.append(float(one.bias[row]))
                    units.append(unit_of(axes[channel]))
                    continue
                kind = "scale" if column == row else "coupling"
                source = "" if column == row else f"_{axes[group[column]]}"
                names.append(f"sensor_{kind}_{axes[channel]}{source}")
                values.append(float(one.matrix[row, column]))
                units.append(_ratio(unit_of(axes[channel]), unit_of(axes[group[column]])))
    covariance: FloatArray = block_diag(*parts)
    return names, np.array(values), units, covariance, np.array(freedom)


def _determined_channels(one: Linear) -> FloatArray:
    """(m + 1,) True for channels of the true signal, and the bias, that are determined."""
    reached = np.ones(one.matrix.shape[1] + 1, dtype=bool)
    for direction in one.undetermined:
        reached &= np.abs(direction) < 0.05
    return reached


def _undetermined_parameters(
    found: Sequence[Linear], groups: Sequence[tuple[int, ...]], axes: Sequence[str]
) -> list[str]:
    words = []
    for one, group in zip(found, groups, strict=True):
        names = [*(axes[channel] for channel in group), "bias"]
        for direction in one.undetermined:
            terms = [
                f"{share:+.2f} {name}"
                for share, name in zip(direction, names, strict=True)
                if abs(share) >= 0.05
            ]
            words.append(" ".join(terms))
    return words


def _ratio(over: str, under: str) -> str:
    if over == under:
        return "1"
    return {("N", "N*m"): "1/m", ("N*m", "N"): "m"}[over, under]
