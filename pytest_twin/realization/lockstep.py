"""Step a batch of simulations, with a callback before each step."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np

from pytest_twin.realization.engine import Batch, BatchError

# Steps between two checks for diverged rows.
_STEPS_PER_CHECK = 8


def lockstep(batch: Batch, steps: int, before: Callable[[int], None]) -> None:
    """Step a batch ``steps`` times, and call ``before(k)`` before step ``k``.

    A row that diverged (``batch.warning`` counts it) is not stepped further, because MuJoCo would
    reset it at every step, at several times the cost of a step. Its state is invalid from then on.
    The function returns early when all rows have diverged.
    """
    valid_rows = None
    for k in range(steps):
        before(k)
        # A row that raises keeps its state, and the other rows are stepped.
        with contextlib.suppress(BatchError):
            batch.step(valid_rows)
        if k % _STEPS_PER_CHECK == 0:
            diverged = batch.warning[:, :, 1].any(axis=1)
            if diverged.any():
                valid_rows = np.flatnonzero(~diverged)
                if not len(valid_rows):
                    break
