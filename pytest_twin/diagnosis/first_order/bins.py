"""Bins: short intervals of segments over which residuals and sensitivities are averaged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.settings import FIRST_ORDER
from pytest_twin.diagnosis.problem import Problem


@dataclass(frozen=True, slots=True)
class Bins:
    """Division of the stacked samples of segments into bins.

    Attributes:
        edges: index of the first sample of every bin.
        counts: number of samples in each bin.
        lengths: number of bins of each segment.
    """

    edges: NDArray[np.int64]
    counts: NDArray[np.int64]
    lengths: tuple[int, ...]

    def mean(self, stacked: FloatArray) -> FloatArray:
        """Means over each bin, (bins, ...), of (samples, ...) values."""
        total = np.add.reduceat(stacked, self.edges, axis=0)
        out: FloatArray = total / self.counts.reshape(-1, *([1] * (stacked.ndim - 1)))
        return out


def bins(problem: Problem, segments: NDArray[np.int64]) -> Bins:
    """Bins of the usual width, wider if there are many signals. Each has at least one sample."""
    edges, counts, lengths, at = [], [], [], 0
    times = [problem.simulator.segments[s].time for s in segments]
    seconds = sum(float(t[-1] - t[0]) for t in times) * len(problem.signal_floor)
    width = float(
        np.clip(seconds / FIRST_ORDER.most_binned, FIRST_ORDER.bin, FIRST_ORDER.widest_bin)
    )
    for time in times:
        stride = max(1, round(width / float(np.median(np.diff(time)))))
        first = np.arange(0, len(time), stride)
        edges.append(at + first)
        counts.append(np.diff(np.append(first, len(time))))
        lengths.append(len(first))
        at += len(time)
    return Bins(np.concatenate(edges), np.concatenate(counts), tuple(lengths))
