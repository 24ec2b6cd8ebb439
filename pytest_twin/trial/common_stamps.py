"""Resample joints from separate messages to the stamps of one joint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.trial.gaps import GAP_INTERVALS
from pytest_twin.trial.trial import Trial


def resample_to_common_stamps(trial: Trial) -> Trial:
    """Resample all joints to the stamps of the joint with the fewest samples.

    Other joints are interpolated by a cubic Hermite spline (error of order interval^4), unless they
    have a sample at the stamp; a note states this. Stamps at which a joint has no neighbouring
    sample within its usual interval are left out.
    """
    if trial.is_dense:
        return trial
    carried = np.isfinite(trial.position)
    slowest = int(np.argmin(carried.sum(axis=0)))
    keep = carried[:, slowest].copy()
    keep[0] = True
    time = trial.time[keep]
    columns, moved = [], 0.0
    near = np.ones(len(time), dtype=bool)
    for position, mine in zip(trial.position.T, carried.T, strict=True):
        own = trial.time[mine]
        if not mine[keep].all():
            after = np.clip(np.searchsorted(own, time), 1, len(own) - 1)
            usual = float(np.median(np.diff(own)))
            inside = (time >= own[0]) & (time <= own[-1])
            near &= inside & (own[after] - own[after - 1] <= GAP_INTERVALS * usual)
            away = np.minimum(time - own[after - 1], own[after] - time)
            moved = max(moved, float(away[inside].max(initial=0.0)))
        columns.append(_cubic(own, position[mine], time))
    near[0] = True
    rows = np.flatnonzero(keep)[near]
    note = (
        f"joints come in separate messages: they are compared at the stamps of "
        f"{trial.joints[slowest]}; the others are interpolated there, from samples at most "
        f"{1e3 * moved:.3g} ms away"
        if moved
        else f"{len(trial.time) - len(rows)} states without a position of some joint are left out"
    )
    return replace(
        trial,
        time=trial.time[rows],
        position=np.stack(columns, axis=1)[near],
        velocity=_linear(trial.velocity, trial.time, rows),
        effort=_linear(trial.effort, trial.time, rows),
        notes=(*trial.notes, note),
    )


def _cubic(time: FloatArray, values: FloatArray, at: FloatArray) -> FloatArray:
    """Cubic Hermite interpolation; exact where ``at`` is one of the times."""
    from scipy.interpolate import CubicHermiteSpline

    time, first = np.unique(time, return_index=True)
    values = values[first]
    if len(time) < 3:
        linear: FloatArray = np.interp(at, time, values)
        return linear
    curve = CubicHermiteSpline(time, values, np.gradient(values, time))
    found: FloatArray = curve(np.clip(at, time[0], time[-1]))
    return found


def _linear(
    table: FloatArray | None, time: FloatArray, rows: NDArray[np.int64]
) -> FloatArray | None:
    if table is None:
        return None
    columns = []
    for values in table.T:
        seen = np.isfinite(values)
        some = seen.any()
        columns.append(np.interp(time[rows], time[seen], values[seen]) if some else values[rows])
    return np.stack(columns, axis=1)
