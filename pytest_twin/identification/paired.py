"""Whether one model predicts held-out motion better than another, beyond chance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.evidence import effective_samples

ONE_SIDED = 1.645
"""Standard errors that a mean exceeds by chance in one of 20 cases."""


@dataclass(frozen=True, slots=True)
class Paired:
    """The fall of a squared error, sample by sample.

    Attributes:
        fall: mean of squared error before minus after, in the squared unit of the errors.
        standard_error: of the mean, for samples that are correlated in time.
    """

    fall: float
    standard_error: float

    @property
    def is_significant(self) -> bool:
        """Whether the error falls by more than chance explains (one-sided, 5 %)."""
        return self.fall > ONE_SIDED * self.standard_error


def paired(before: FloatArray, after: FloatArray, lengths: Sequence[int]) -> Paired:
    """The paired comparison of two models' errors on the same samples.

    Both errors contain the same noise, so that their difference shows less of it than either
    (Diebold, Mariano, Journal of Business and Economic Statistics 13, 1995). Differences that are
    correlated in time count as their effective samples (Geyer 1992).

    Args:
        before, after: (n, signals) errors of the two, each signal over its scale.
        lengths: samples of each recording, one after another.
    """
    change = np.sum(before**2 - after**2, axis=1)
    if not np.isfinite(change).all():
        return Paired(np.inf if np.isfinite(after).all() else -np.inf, 0.0)
    effective = float(effective_samples((change - change.mean())[:, None], lengths)[0])
    return Paired(float(change.mean()), float(change.std() / np.sqrt(max(effective, 1.0))))
