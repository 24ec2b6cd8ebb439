"""True times of sensor readings, and predicted readings of a motion at their stamps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import Effect, Values
from pytest_twin.effects.segment import Predicted, Segment


def age_of_initial_state(
    segments: Sequence[Segment], effects: Sequence[tuple[Effect, Values]], columns: int
) -> FloatArray:
    """(rows, columns) age of the initial state relative to its stamp, s.

    A window starts from a measured state, which is as old as the readings. A whole trial starts at
    rest, so the age is 0.

    Args:
        segments: segment of each row.
        effects: effects with their (rows, columns) parameters.
        columns: number of columns.
    """
    start = np.array([s.start for s in segments])[:, None, None]
    stamp = np.repeat(start, columns, axis=2)
    taken = stamp
    for effect, v in effects:
        taken = effect.sample_time(taken, v)
    window = np.array([s.starts_in_motion for s in segments])
    out: FloatArray = np.where(window[:, None], (stamp - taken)[:, 0], 0.0)
    return out


def true_reading_times(
    segments: Sequence[Segment],
    stamps: FloatArray,
    effects: Sequence[tuple[Effect, Values]],
) -> FloatArray:
    """(rows, n, columns) true times of readings with the given stamps, on the motion's clock, s."""
    for effect, v in effects:
        stamps = effect.sample_time(stamps, v)
    return stamps + age_of_initial_state(segments, effects, stamps.shape[2])[:, None]


def predicted_readings(
    segments: Sequence[Segment],
    effects: Sequence[tuple[Effect, Values]],
    motion: tuple[FloatArray, FloatArray, FloatArray],
    timestep: float,
) -> list[Predicted]:
    """Predicted sensor readings of each row.

    Positions between steps are cubic Hermite interpolants.

    Args:
        segments: segment of each row.
        effects: effects with their (rows, joints) parameters.
        motion: (rows, steps + 1, joints) positions, velocities and efforts, SI units.
        timestep: time step of the motion, s.
    """
    q, v, effort = motion
    longest = max(len(s.time) for s in segments)
    stamps = np.empty((len(segments), longest, q.shape[2]))
    for i, s in enumerate(segments):
        stamps[i, : len(s.time)] = s.time[:, None]
        stamps[i, len(s.time) :] = s.time[-1]
    stamps = true_reading_times(segments, stamps, effects)
    start = np.array([s.start for s in segments])[:, None, None]
    at = np.clip((stamps - start) / timestep, 0.0, q.shape[1] - 1 - 1e-9)
    index = at.astype(np.int64)
    part = at - index
    before_q, after_q = (np.take_along_axis(q, index + d, axis=1) for d in (0, 1))
    before_v, after_v = (np.take_along_axis(v, index + d, axis=1) for d in (0, 1))
    rest = 1.0 - part
    step = after_q - before_q
    bend = rest * (timestep * before_v - step) - part * (timestep * after_v - step)
    position = before_q + part * step + part * rest * bend
    velocity = before_v + part * (after_v - before_v)
    given = np.take_along_axis(effort, index, axis=1)
    for effect, p in effects:
        position, velocity = effect.sense(stamps, position, velocity, p)
        given = effect.sense_effort(given, p)
    return [
        Predicted(*(x[i, : len(s.time)] for x in (position, velocity, given)))
        for i, s in enumerate(segments)
    ]
