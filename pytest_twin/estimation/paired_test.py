"""Paired test: does one model predict held-out motion significantly better than another?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.estimation.score import effective_samples

ONE_SIDED = 1.645
"""One-sided 5 % quantile of the normal distribution."""
_MOST = 0.75
"""Share of the squared error that no chance removes: the root mean square error halves. A limit
that is reached once leaves a single event, whose mean is never significant."""


@dataclass(frozen=True, slots=True)
class PairedTest:
    """Mean reduction of a squared error over paired samples.

    Attributes:
        reduction: mean of squared error before minus after, in the squared unit of the errors.
        standard_error: standard error of the mean, for samples correlated in time.
        share: ``reduction`` relative to the mean squared error before.
    """

    reduction: float
    standard_error: float
    share: float

    @property
    def is_significant(self) -> bool:
        """Whether the reduction is significant (one-sided, 5 %), or halves the error."""
        return self.reduction > ONE_SIDED * self.standard_error or self.share > _MOST


def compare_paired(before: FloatArray, after: FloatArray, lengths: Sequence[int]) -> PairedTest:
    """Compare the errors of two models on the same samples.

    Both errors contain the same noise, so their difference has less noise than either (Diebold,
    Mariano, Journal of Business and Economic Statistics 13, 1995). For differences that are
    correlated in time, the effective sample size is used (Geyer 1992).

    Args:
        before, after: (n, signals) errors of both models, each signal divided by its scale.
        lengths: number of samples of each recording, in the order of the rows.
    """
    change = np.sum(before**2 - after**2, axis=1)
    if not np.isfinite(change).all():
        reduction = np.inf if np.isfinite(after).all() else -np.inf
        return PairedTest(reduction, 0.0, reduction)
    effective = float(effective_samples((change - change.mean())[:, None], lengths)[0])
    reduction = float(change.mean())
    size = max(float(np.mean(np.sum(before**2, axis=1))), 1e-300)
    return PairedTest(
        reduction, float(change.std() / np.sqrt(max(effective, 1.0))), reduction / size
    )
