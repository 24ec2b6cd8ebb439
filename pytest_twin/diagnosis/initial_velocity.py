"""Recordings without velocities that begin amid a motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.active_effects import EffectValues
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment

# s of a recording that tell how it began, and the share of the misfit there, at rest, that a start
# in motion may leave: what the model lacks stays in either.
_BEGINNING, _CLEARLY = 0.25, 0.2


def with_initial_velocity(
    segments: Sequence[Segment],
    moving: Mapping[int, Segment],
    joints: Sequence[str],
    noise: FloatArray,
    *,
    threads: int,
    fixed: EffectValues | None,
) -> list[Segment]:
    """Segments as they are, or as they move from the start where that is clearly nearer.

    Args:
        segments: all of a problem, those without velocities at rest.
        moving: of some of them, the same with a velocity that their first samples say.
        joints: their columns.
        noise: (joints,) deviation of a sample, rad or m.
        threads, fixed: as :class:`BatchSimulator` takes them.
    """
    out = list(segments)
    if not moving:
        return out
    tried = [
        s.part(s.time <= s.time[0] + _BEGINNING)
        for i, other in moving.items()
        for s in (segments[i], other)
    ]
    simulator = BatchSimulator(tried, joints, threads=threads, fixed=fixed)
    found = simulator.simulate(np.arange(len(tried)), {})
    alive = noise > 0.0  # an encoder that is stuck says nothing
    left = [
        float(np.sum(((s.position - p.position)[:, alive] / noise[alive]) ** 2))
        for s, p in zip(tried, found, strict=True)
    ]
    for k, (i, other) in enumerate(moving.items()):
        if left[2 * k + 1] < _CLEARLY * left[2 * k]:
            out[i] = other
    return out
