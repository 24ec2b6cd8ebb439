"""Initial velocity of recordings that have no measured velocities and begin during a motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.window_settings import WINDOWS
from pytest_twin.effects.active_effects import EffectValues
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment


def choose_initial_velocity(
    segments: Sequence[Segment],
    moving: Mapping[int, Segment],
    joints: Sequence[str],
    noise: FloatArray,
    *,
    threads: int,
    fixed: EffectValues | None,
) -> list[Segment]:
    """Segments with the better initial velocity: zero, or the estimate from the first samples.

    Args:
        segments: all segments of a problem; those without measured velocities start at rest.
        moving: index of a segment -> the same segment with its estimated initial velocity.
        joints: names of the columns.
        noise: (joints,) standard deviation of a position sample, rad or m.
        threads, fixed: as in :class:`BatchSimulator`.
    """
    out = list(segments)
    if not moving:
        return out
    tried = [
        s.part(s.time <= s.time[0] + WINDOWS.beginning)
        for i, other in moving.items()
        for s in (segments[i], other)
    ]
    simulator = BatchSimulator(tried, joints, threads=threads, fixed=fixed)
    found = simulator.simulate(np.arange(len(tried)), {})
    has_noise = noise > 0.0  # a stuck encoder has no noise and gives no information
    misfit = [
        float(np.sum(((s.position - p.position)[:, has_noise] / noise[has_noise]) ** 2))
        for s, p in zip(tried, found, strict=True)
    ]
    for k, (i, other) in enumerate(moving.items()):
        if misfit[2 * k + 1] < WINDOWS.velocity_misfit * misfit[2 * k]:
            out[i] = other
    return out
