"""Smoothing and differentiation of sampled motions by local cubics."""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray

SMOOTHING_WIDTH = 0.12
"""Width in s of the window in which motions are differentiated."""


def derivatives(
    time: FloatArray, values: FloatArray, width: float = SMOOTHING_WIDTH
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Smoothed values and their first two derivatives, by local cubics over ``width`` s.

    Args:
        time: (n,) s, ascending; may be irregular.
        values: (n, k) samples.
        width: width of the window, s.

    Returns:
        Smoothed values, first and second derivatives, (n, k) each.
    """
    n = len(time)
    usual = float(np.median(np.diff(time))) if n > 1 else 1.0
    half = max(round(0.5 * width / max(usual, 1e-6)), 3)
    out = np.empty((3, *values.shape))
    grid = time[0] + usual * np.arange(int(np.ceil((time[-1] - time[0]) / usual)) + 1)
    even = np.stack([np.interp(grid, time, values[:, k]) for k in range(values.shape[1])], axis=1)
    offsets = np.arange(-half, half + 1) * usual
    basis = np.vander(offsets / (half * usual), 4, increasing=True)
    weights = np.linalg.pinv(basis)
    padded = np.pad(even, ((half, half), (0, 0)), mode="reflect", reflect_type="odd")
    for order, factor in ((0, 1.0), (1, 1.0), (2, 2.0)):
        kernel = weights[order] * factor / (half * usual) ** order
        smooth = np.stack(
            [np.correlate(padded[:, k], kernel, mode="valid") for k in range(values.shape[1])],
            axis=1,
        )
        for k in range(values.shape[1]):
            out[order, :, k] = np.interp(time, grid, smooth[:, k])
    return out[0], out[1], out[2]


def smooth_state(
    time: FloatArray, position: FloatArray, at: float, width: float
) -> tuple[FloatArray, FloatArray]:
    """Position and velocity at one time, by a local cubic.

    Args:
        time: (n,) s.
        position: (n, joints) rad or m.
        at: time of the state, s.
        width: width of the window, s; at least the six nearest samples are used.

    Returns:
        (joints,) position, rad or m, and velocity, rad/s or m/s.
    """
    near = np.flatnonzero(np.abs(time - at) <= width / 2)
    if len(near) < 6:
        near = np.argsort(np.abs(time - at))[:6]
    t = (time[near] - at) / (width / 2)
    basis = np.vander(t, 4, increasing=True)
    coefficients, *_ = np.linalg.lstsq(basis, position[near], rcond=None)
    return coefficients[0], coefficients[1] / (width / 2)
