"""Evidence of a change of each law, and how much less it is worth than that of a known scatter.

The later recordings are modelled as ``y = Phi (theta + d) + Phi_j delta + e``. The laws of the
background ``theta`` have the estimate and covariance of the earlier recordings; their deviations
``d`` from session to session and the noise ``e`` have the estimated scatter. With these
marginalized, the change ``delta`` of one law has the information ``I`` and the right side ``b`` of
a :class:`Contrast`. The scatter is estimated from few sessions and is too small; sessions that are
left out show by which factor, the inflation ``t``. All of the covariance is ``t`` times as large,
so ``I`` and ``b`` are both divided by it (quasi-likelihood: McCullagh, Nelder 1989, ch. 9). With
the prior ``delta ~ N(0, P)`` follow the covariance ``V = (I / t + P^-1)^-1``, the estimate
``V b / t`` and the log evidence against no change ``b V b / (2 t^2) - log|1 + P I / t| / 2``. A
prior of several equally probable covariances gives the mean of the evidences.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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


@dataclass(frozen=True)
class Estimate:
    """Changes of several laws with equally many amplitudes.

    Attributes:
        evidence: (n,) log evidence of each against no change.
        value: (n, k) its amplitudes under the most probable prior.
        covariance: (n, k, k) their covariance.
    """

    evidence: FloatArray
    value: FloatArray
    covariance: FloatArray


def estimated(
    contrast: Contrast, columns: NDArray[np.intp], priors: FloatArray, inflation: float
) -> Estimate:
    """Evidence and change of several laws, as derived above.

    Args:
        columns: (n, k) columns of each law.
        priors: (m, k, k) equally probable covariances of the amplitudes.
        inflation: factor on the covariance of the rows.
    """
    information = contrast.information[columns[:, :, None], columns[:, None, :]] / inflation
    vector = contrast.vector[columns] / inflation
    shrunk = np.eye(columns.shape[1]) + priors[:, None] @ information
    covariance = np.linalg.solve(shrunk, np.broadcast_to(priors[:, None], shrunk.shape))
    value = np.einsum("mnab,nb->mna", covariance, vector)
    each = 0.5 * np.einsum("na,mna->mn", vector, value) - 0.5 * np.linalg.slogdet(shrunk)[1]
    best, laws = each.argmax(axis=0), np.arange(len(columns))
    evidence = np.logaddexp.reduce(each, axis=0) - np.log(len(priors))
    return Estimate(np.asarray(evidence), value[best, laws], covariance[best, laws])


def sizes(unit: FloatArray) -> FloatArray:
    """(sizes, k, k) covariances of a change that may be much larger than usual.

    Args:
        unit: (k, k) covariance of the amplitudes, relative to that of a usual change.
    """
    return np.square(AMPLITUDE_PRIOR * np.array(_LARGER))[:, None, None] * unit


def evidence_of(contrast: Contrast, shapes: Sequence[Shape], inflation: float) -> FloatArray:
    """(shapes,) log evidence of a change of each law against no change, of equal priors."""
    evidence = np.empty(len(shapes))
    for which, columns in _of_equal_size(shapes):
        priors = sizes(np.eye(columns.shape[1]))
        evidence[which] = estimated(contrast, columns, priors, inflation).evidence
    return evidence


def _of_equal_size(
    shapes: Sequence[Shape],
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """For each number of amplitudes k: (n,) which shapes have it, and their (n, k) columns."""
    amplitudes = np.array([len(shape.columns) for shape in shapes])
    for count in np.unique(amplitudes):
        (which,) = np.nonzero(amplitudes == count)
        yield which, np.array([shapes[k].indices for k in which.tolist()])


@dataclass(frozen=True)
class SeemingChanges:
    """How much laws seem to change in sessions where nothing changed.

    Attributes:
        squares: (sessions, shapes) twice the gain of log-likelihood by a change.
        determined: (sessions, shapes) number of amplitudes that the rows determine, the trace of
            ``V I``. Where the covariance is as assumed, it is the mean of ``squares``.
        joints: (shapes,) joint of each law.
    """

    squares: FloatArray
    determined: FloatArray
    joints: NDArray[np.intp]

    @classmethod
    def of(cls, left_out: Sequence[Contrast], shapes: Sequence[Shape]) -> SeemingChanges:
        """Those of sessions that are left out of the background."""
        squares, determined = np.zeros((2, len(left_out), len(shapes)))
        for which, columns in _of_equal_size(shapes):
            usual = AMPLITUDE_PRIOR**2 * np.eye(columns.shape[1])[None]
            for at, contrast in enumerate(left_out):
                change = estimated(contrast, columns, usual, 1.0)
                information = contrast.information[columns[:, :, None], columns[:, None, :]]
                squares[at, which] = (contrast.vector[columns] * change.value).sum(axis=1)
                determined[at, which] = np.einsum("nab,nba->n", change.covariance, information)
        return cls(squares, determined, np.array([shape.term.joint for shape in shapes]))

    def inflation(self, without: int | None = None) -> float:
        """Mean over joints of how much more laws seem to change than a known scatter explains.

        The factor of a joint is at least 1.

        Args:
            without: session that does not count; None if all do.
        """
        used = np.arange(len(self.squares)) != (-1 if without is None else without)
        squares, determined = self.squares[used].sum(axis=0), self.determined[used].sum(axis=0)
        ratios = [
            max(float(squares[own].sum() / max(determined[own].sum(), 1e-300)), 1.0)
            for own in (self.joints == joint for joint in np.unique(self.joints))
        ]
        return float(np.exp(np.mean(np.log(ratios))))
