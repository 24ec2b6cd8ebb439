"""Evidence of a change of each law, and how much less it is worth than that of a known scatter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from pytest_twin.arrays import FloatArray
from pytest_twin.changes.background import Contrast
from pytest_twin.changes.scatter import AMPLITUDE_PRIOR
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.identification.effort.law_columns import Shape

TWO_SIDED = 0.975
"""Quantile outside which an amplitude is significant."""
_LARGER = (1.0, 10.0, 100.0)
"""Sizes of a change in multiples of its usual one, of equal prior probability: a payload on light
wrists is ten times their effort before."""


@dataclass(frozen=True)
class Tempering:
    """How much less the evidence is worth than that of a known Gaussian scatter.

    Attributes:
        inflation: mean of twice the gain per amplitude where nothing changed; 1 for a scatter that
            is known. It is one factor for all joints: else a law would be likelier because of the
            joints on which it acts.
        freedom: degrees of freedom of the scatter.
    """

    inflation: float
    freedom: int

    def odds(self, deficit: FloatArray) -> FloatArray:
        """Log odds under Student's t law, where those under a Gaussian law are ``-deficit``.

        Args:
            deficit: (n,) log evidence of the best explanation minus that of each, not negative.
        """
        freedom = self.freedom
        return np.asarray(-0.5 * (freedom + 1.0) * np.log1p(2.0 * deficit / freedom))

    def by_law(self, terms: Sequence[Term], evidence: FloatArray) -> dict[Term, float]:
        """Law -> its log odds against no change.

        A law with many shapes is not likelier because of them.

        Args:
            terms: law of each shape.
            evidence: (shapes,) log evidence against no change.
        """
        every = np.append(evidence, 0.0)
        *odds, no_change = self.odds(every.max() - every).tolist()
        of_law: dict[Term, list[float]] = {}
        for term, log_odds in zip(terms, odds, strict=True):
            of_law.setdefault(term, []).append(log_odds - no_change)
        return {
            term: float(np.logaddexp.reduce(each) - np.log(len(each)))
            for term, each in of_law.items()
        }

    def score(self, shapes: Sequence[Shape], evidence: FloatArray) -> float:
        """Log odds that some law changed against no change, where all laws are equally likely."""
        of_law = list(self.by_law([shape.term for shape in shapes], evidence).values())
        return float(np.logaddexp.reduce(of_law) - np.log(len(of_law)))

    def significant(self, value: FloatArray, covariance: FloatArray) -> NDArray[np.bool_]:
        """(k,) whether each amplitude differs from 0.

        Args:
            value, covariance: (k,) and (k, k) of the amplitudes.
        """
        deviations = float(stdtrit(self.freedom, TWO_SIDED))
        return np.asarray(np.abs(value) > deviations * np.sqrt(np.diag(covariance)))


def gains_of(
    contrast: Contrast, shapes: Sequence[Shape], larger: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """(shapes,) gain of log-likelihood by a change of each law, and its penalty (Occam factor).

    Args:
        larger: size of the change in multiples of its usual one.
    """
    deviation = larger * AMPLITUDE_PRIOR
    gains, penalties = np.empty(len(shapes)), np.empty(len(shapes))
    amplitudes = np.array([len(shape.columns) for shape in shapes])
    for count in np.unique(amplitudes):
        (which,) = np.nonzero(amplitudes == count)
        columns = np.array([shapes[k].indices for k in which.tolist()])
        precision = contrast.information[columns[:, :, None], columns[:, None, :]]
        precision = precision + np.eye(count) / deviation**2
        vector = contrast.vector[columns]
        change = np.linalg.solve(precision, vector[..., None])[..., 0]
        gains[which] = 0.5 * (vector * change).sum(axis=1)
        penalties[which] = 0.5 * np.linalg.slogdet(precision * deviation**2)[1]
    return gains, penalties


def evidence_of(contrast: Contrast, shapes: Sequence[Shape], tempering: Tempering) -> FloatArray:
    """(shapes,) log evidence of a change of each law against no change, of equal priors."""
    # A change may be much larger than usual.
    each = [gains_of(contrast, shapes, larger) for larger in _LARGER]
    of_size = np.array([gains / tempering.inflation - penalties for gains, penalties in each])
    return np.asarray(np.logaddexp.reduce(of_size, axis=0) - np.log(len(_LARGER)))


def estimate(
    contrast: Contrast, columns: NDArray[np.intp], inflation: float
) -> tuple[float, FloatArray, FloatArray]:
    """Log evidence against no change, (k,) change of amplitudes and (k, k) covariance."""
    information = contrast.information[np.ix_(columns, columns)]
    vector = contrast.vector[columns]
    best: tuple[float, FloatArray, FloatArray] | None = None
    evidences = []
    for larger in _LARGER:
        variance = (larger * AMPLITUDE_PRIOR) ** 2
        precision = information + np.eye(len(columns)) / variance
        change = np.asarray(np.linalg.solve(precision, vector), dtype=np.float64)
        penalty = 0.5 * float(np.linalg.slogdet(precision * variance)[1])
        evidences.append(0.5 * float(vector @ change) / inflation - penalty)
        if best is None or evidences[-1] > best[0]:
            covariance = np.asarray(inflation * np.linalg.inv(precision), dtype=np.float64)
            best = evidences[-1], change, covariance
    assert best is not None
    evidence = float(np.logaddexp.reduce(evidences) - np.log(len(_LARGER)))
    return evidence, best[1], best[2]
