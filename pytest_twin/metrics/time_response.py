"""Metrics of a step response: rise, overshoot, settling, steady state.

A metric that the response does not determine is None.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray

TAIL = 0.1
"""Fraction of the time, at its end, in which the response must stay in the band."""


@dataclass(frozen=True, slots=True)
class StepMetrics:
    """Metrics of a step response (Franklin, Powell, Emami-Naeini, Feedback Control, ch. 3.4).

    Attributes:
        final: mean over the last tenth, in the unit of the response; None if the response does
            not stay within the band around it.
        rise_time: time from 10 % to 90 % of the change, s.
        overshoot: peak beyond the final value as a fraction of the change, not negative.
        settling_time: time from the step until the response stays within the band, s.
        steady_state_error: (target - final) / (target - start), None without a target.
    """

    final: float | None
    rise_time: float | None
    overshoot: float | None
    settling_time: float | None
    steady_state_error: float | None


def step_metrics(
    time: FloatArray,
    response: FloatArray,
    *,
    target: float | None = None,
    band: float = 0.02,
    smallest: float = 0.0,
) -> StepMetrics:
    """Metrics of a response to a step at ``time[0]``.

    Args:
        time: (n,) s, increasing.
        response: (n,) response; its first value is the initial value.
        target: commanded final value, in the unit of the response.
        band: settling band as a fraction of the change.
        smallest: change up to which there is no response, in the unit of the response.
    """
    start = float(response[0])
    final = float(np.mean(response[_tail(time)]))
    change = final - start
    nothing = StepMetrics(None, None, None, None, None)
    if not np.isfinite(response).all() or abs(change) <= smallest or change == 0.0:
        return nothing
    fraction = (response - start) / change
    if np.any(np.abs(fraction[_tail(time)] - 1.0) > band):
        return nothing
    ten = _first_crossing(time, fraction, 0.1)
    ninety = _first_crossing(time, fraction, 0.9)
    error = None
    if target is not None and target != start:
        error = (target - final) / (target - start)
    return StepMetrics(
        final=final,
        rise_time=None if ten is None or ninety is None else ninety - ten,
        overshoot=max(0.0, float(fraction.max()) - 1.0),
        settling_time=settling_time(time, fraction[:, None], np.array([1.0]), np.array([band])),
        steady_state_error=error,
    )


def settling_time(
    time: FloatArray, values: FloatArray, final: FloatArray, band: FloatArray
) -> float | None:
    """Time from which all columns stay within ``band`` of ``final``, s after ``time[0]``.

    Args:
        time: (n,) s.
        values: (n, k).
        final: (k,).
        band: (k,) in the units of the columns.

    Returns:
        None where a column is outside its band in the last tenth of the time.
    """
    excess = np.max(np.abs(values - final) / band, axis=1)
    outside = np.flatnonzero(~(excess <= 1.0))
    if outside.size == 0:
        return 0.0
    last = int(outside[-1])
    if last + 1 >= time.size or time[last] >= _tail_start(time):
        return None
    # Interpolated time at which the largest excess returns to the band.
    share = (excess[last] - 1.0) / (excess[last] - excess[last + 1])
    return float(time[last] + share * (time[last + 1] - time[last]) - time[0])


def worst_sample(
    time: FloatArray, now: FloatArray, golden: FloatArray
) -> tuple[float, float, float, float]:
    """(error, time, now, golden) at the largest difference of two series; NaN counts as largest."""
    error = np.abs(now - golden)
    index = int(np.argmax(np.where(np.isnan(error), np.inf, error)))
    return float(error[index]), float(time[index]), float(now[index]), float(golden[index])


def _tail_start(time: FloatArray) -> float:
    return float(time[-1] - TAIL * (time[-1] - time[0]))


def _tail(time: FloatArray) -> NDArray[np.bool_]:
    tail: NDArray[np.bool_] = time >= _tail_start(time)
    return tail


def _first_crossing(time: FloatArray, fraction: FloatArray, level: float) -> float | None:
    above = np.flatnonzero(fraction >= level)
    if above.size == 0:
        return None
    k = int(above[0])
    if k == 0:
        return float(time[0])
    share = (level - fraction[k - 1]) / (fraction[k] - fraction[k - 1])
    return float(time[k - 1] + share * (time[k] - time[k - 1]))
