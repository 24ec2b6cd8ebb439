"""Origin of a logged velocity (a sensor, or differences of the positions) and its age.

A velocity from differences of positions is half a sample period old, and older after a low-pass
filter. Its noise is that of the positions. It is not used as an initial state.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.noise import sensor_noise
from pytest_twin.diagnosis.signal_meaning.fact import Fact, unknown
from pytest_twin.diagnosis.signal_meaning.settings import RECORDED_VELOCITY

Kind = Literal["sensor", "differenced", "filtered"]


@dataclass(frozen=True, slots=True)
class VelocitySignal:
    """Origin and age of a logged velocity.

    Attributes:
        lag: age relative to the position of the same message, s.
        lag_error: standard error of ``lag``, s.
        bandwidth: corner frequency of the driver's first-order filter, Hz; infinite without one.
    """

    kind: Kind
    lag: float
    lag_error: float
    bandwidth: float


def velocity_signal(
    time: FloatArray, position: FloatArray, velocity: FloatArray
) -> VelocitySignal | None:
    """Origin and age of a velocity, from the positions of the same messages.

    Args:
        time: (n,) ascending times, s.
        position, velocity: (n,) values of one joint, finite.

    Returns:
        None if the recording is too short or the joint does not move.
    """
    if len(time) < RECORDED_VELOCITY.fewest_samples or not np.ptp(position) or not np.ptp(velocity):
        return None
    return _detect_derived_velocity(time, position, velocity) or _detect_own_sensor(
        time, position, velocity
    )


def _detect_derived_velocity(
    time: FloatArray, position: FloatArray, velocity: FloatArray
) -> VelocitySignal | None:
    """A velocity that was computed from the logged positions; None if it was not."""
    period = float(np.median(np.diff(time)))
    slope = np.diff(position) / np.diff(time)
    noise = float(sensor_noise(time, position[:, None])[0])
    own = np.sqrt(2.0) * noise / period
    central = np.gradient(position, time)[1:-1]
    if _rms(velocity[1:-1] - central) < RECORDED_VELOCITY.derived * own / 2.0:
        return VelocitySignal("differenced", 0.0, 0.0, np.inf)
    columns = np.stack([velocity[:-1], slope], axis=1)
    weights, *_ = np.linalg.lstsq(columns, velocity[1:], rcond=None)
    keep, share = (float(w) for w in weights)
    if share <= 0.0 or not keep < 1.0:
        return None
    if _rms(velocity[1:] - columns @ weights) > RECORDED_VELOCITY.derived * share * own:
        return None
    keep = max(keep, 0.0)
    lag = period * (0.5 + keep / (1.0 - keep))
    if keep < RECORDED_VELOCITY.filters:
        return VelocitySignal("differenced", lag, 0.0, np.inf)
    return VelocitySignal("filtered", lag, 0.0, float(-np.log(keep) / (2.0 * np.pi * period)))


def _detect_own_sensor(
    time: FloatArray, position: FloatArray, velocity: FloatArray
) -> VelocitySignal:
    """A velocity of an independent sensor, with its age by regression on the acceleration.

    The mean velocity over two periods, by Simpson's rule, is compared with the position difference.
    """
    period = float(np.median(np.diff(time)))
    even = np.abs(np.diff(time) - period) < RECORDED_VELOCITY.even * period
    mean = (velocity[:-2] + 4.0 * velocity[1:-1] + velocity[2:]) / 6.0
    span = time[2:] - time[:-2]
    moved = (position[2:] - position[:-2]) / span
    change = (velocity[2:] - velocity[:-2]) / span
    inside = even[:-1] & even[1:]
    columns = np.stack([change[inside], np.ones(int(inside.sum()))], axis=1)
    off = (moved - mean)[inside]
    weights, *_ = np.linalg.lstsq(columns, off, rcond=None)
    rest = off - columns @ weights
    # Each sample takes part in several differences, so their errors are correlated.
    variance = RECORDED_VELOCITY.shared * float(rest @ rest) / max(len(rest) - 2, 1)
    covariance = variance * np.linalg.pinv(columns.T @ columns)
    return VelocitySignal("sensor", float(weights[0]), float(np.sqrt(covariance[0, 0])), np.inf)


def velocity_fact(time: FloatArray, position: FloatArray, velocity: FloatArray) -> Fact:
    """Origin and age of a logged velocity as a fact; arguments as :func:`velocity_signal`."""
    found = velocity_signal(time, position, velocity)
    if found is None:
        return unknown("too few samples, or no motion")
    period = float(np.median(np.diff(time)))
    lag = {"lag": (found.lag, "s")}
    if found.kind == "differenced":
        return Fact(
            "differenced", 0.99, "data",
            "the logged velocity is the difference of the logged positions, "
            f"{1e3 * found.lag:.3g} ms old",
            lag,
        )  # fmt: skip
    if found.kind == "filtered":
        return Fact(
            "filtered", 0.99, "data",
            "the logged velocity is the difference of the logged positions through a low-pass "
            f"filter of {found.bandwidth:.3g} Hz, {1e3 * found.lag:.3g} ms old",
            lag | {"bandwidth": (found.bandwidth, "Hz")},
        )  # fmt: skip
    late = abs(found.lag) > max(
        RECORDED_VELOCITY.surely * found.lag_error, RECORDED_VELOCITY.least_age * period
    )
    if late:
        side = "older" if found.lag > 0.0 else "younger"
        return Fact(
            "late", 0.99, "data",
            f"the velocity is {1e3 * abs(found.lag):.3g} ms {side} than the position of the same "
            f"message (standard error {1e3 * found.lag_error:.2g} ms)",
            lag,
        )  # fmt: skip
    return Fact(
        "sensor", 0.95, "data",
        "the velocity has noise that the position does not have, and is as old as the position, to "
        "within "
        f"{1e3 * max(2.0 * found.lag_error, abs(found.lag)):.2g} ms",
        lag,
    )  # fmt: skip


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
