"""Many simulations, one step at a time, with something to say between the steps."""

from __future__ import annotations

from collections.abc import Callable

from mujoco.batch import Batch, SimulationError


def lockstep(batch: Batch, steps: int, before: Callable[[int], None]) -> bool:
    """Step a batch ``steps`` times, calling ``before(k)`` ahead of step ``k``.

    Returns whether every row is still sound; a row that diverged stops and keeps its last state.
    """
    sound = True
    for k in range(steps):
        before(k)
        try:
            batch.step()
        except SimulationError:
            sound = False
    return sound
