"""Many simulations, one step at a time, with something to say between the steps."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np
from mujoco.batch import Batch, SimulationError

# Steps between two looks at which rows diverged.
_LOOK = 8


def lockstep(batch: Batch, steps: int, before: Callable[[int], None]) -> None:
    """Step a batch ``steps`` times, calling ``before(k)`` ahead of step ``k``.

    A row that diverged (``batch.warning`` counts) is not stepped on: the engine would start it anew
    at every step, at several times the cost of one. Its state is worth nothing from there; where no
    other is left, the rest of the steps is not taken.
    """
    sound = None
    for k in range(steps):
        before(k)
        # Rows that raise keep their state, and the others go on.
        with contextlib.suppress(SimulationError):
            batch.step(sound)
        if k % _LOOK == 0:
            lost = batch.warning[:, :, 1].any(axis=1)
            if lost.any():
                sound = np.flatnonzero(~lost)
                if not len(sound):
                    break
