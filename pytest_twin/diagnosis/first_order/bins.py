"""Short stretches of segments over which residuals and sensitivities are averaged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem

_BIN, _COARSEST = 0.02, 0.05
"""s that residuals are averaged over."""
_MOST_BINNED = 12_000


@dataclass(frozen=True, slots=True)
class Bins:
    """Samples of segments averaged over short stretches.

    Attributes:
        edges: first sample of every bin, over all segments stacked.
        counts: samples in each.
        lengths: bins of each segment.
    """

    edges: NDArray[np.int64]
    counts: NDArray[np.int64]
    lengths: tuple[int, ...]

    def mean(self, stacked: FloatArray) -> FloatArray:
        """(bins, ...) means of (samples, ...)."""
        total = np.add.reduceat(stacked, self.edges, axis=0)
        out: FloatArray = total / self.counts.reshape(-1, *([1] * (stacked.ndim - 1)))
        return out


def bins(problem: Problem, segments: NDArray[np.int64]) -> Bins:
    """Bins of ``_BIN`` s, longer where there are many signals; at least a sample each."""
    edges, counts, lengths, at = [], [], [], 0
    times = [problem.simulator.segments[s].time for s in segments]
    seconds = sum(float(t[-1] - t[0]) for t in times) * len(problem.signal_floor)
    width = float(np.clip(seconds / _MOST_BINNED, _BIN, _COARSEST))
    for time in times:
        stride = max(1, round(width / float(np.median(np.diff(time)))))
        first = np.arange(0, len(time), stride)
        edges.append(at + first)
        counts.append(np.diff(np.append(first, len(time))))
        lengths.append(len(first))
        at += len(time)
    return Bins(np.concatenate(edges), np.concatenate(counts), tuple(lengths))
