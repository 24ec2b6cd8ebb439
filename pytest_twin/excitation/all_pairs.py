"""How well one motion tells all laws of a catalogue apart, pair by pair.

One law at its typical size is taken for true, and the other one is fitted to its readings in the
span of its own columns. The fit is linear and has a normal prior of some typical sizes, so that it
needs only the Gram matrix of all columns. The odds are those of ``discrimination``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.estimation.comparison import Comparison, Size
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.excitation.catalogue_responses import LawColumns
from pytest_twin.excitation.discrimination import expected_log_odds

_LARGEST = 3.0
"""Standard deviation of the prior of a coefficient, in typical sizes of a law."""


@dataclass(frozen=True)
class PairOdds:
    """Expected log odds of all laws along one motion.

    Attributes:
        shown: term -> log odds of the law at its typical size against no change.
        pairs: two laws of one joint, or one of them of the whole robot -> log odds of the true one,
            the smaller of both. Only laws that the motion shows are compared.
        needed: probability from which a law shows, and from which two laws are distinguished.
    """

    shown: Mapping[Term, float]
    pairs: Mapping[tuple[Term, Term], float]
    needed: float

    @classmethod
    def of(cls, columns: LawColumns, needed: float) -> PairOdds:
        """Compare all laws along one motion."""
        judge = _Judge(columns)
        least = np.log(needed / (1.0 - needed))
        shown = {term: judge.against_none(term) for term in columns.of_term}
        seen = [term for term, odds in shown.items() if odds >= least]
        pairs = {}
        for first, second in combinations(seen, 2):
            if first.joint == second.joint or min(first.joint, second.joint) < 0:
                pairs[first, second] = min(judge.odds(first, second), judge.odds(second, first))
        return cls(shown, pairs, needed)

    @cached_property
    def distinguished(self) -> frozenset[tuple[Term, Term]]:
        """Pairs that the motion distinguishes."""
        return frozenset(
            pair for pair, odds in self.pairs.items() if probability(odds) >= self.needed
        )

    @cached_property
    def seen(self) -> frozenset[Term]:
        """Laws that the motion shows."""
        return frozenset(
            term for term, odds in self.shown.items() if probability(odds) >= self.needed
        )

    @property
    def rank(self) -> float:
        """Larger for a better motion: expected number of laws and pairs that show."""
        odds = [*self.shown.values(), *self.pairs.values()]
        return float(sum(probability(one) for one in odds))


def probability(log_odds: float) -> float:
    """Probability of given logarithm of odds."""
    return float(1.0 / (1.0 + np.exp(-np.clip(log_odds, -700.0, 700.0))))


class _Judge:
    def __init__(self, columns: LawColumns) -> None:
        self._columns = columns
        by_signal = np.ascontiguousarray(columns.matrix.transpose(2, 0, 1))
        samples = max(by_signal.shape[2], 1)
        # (signals, columns, columns): mean products of the readings.
        self._gram = by_signal @ by_signal.transpose(0, 2, 1) / samples
        self._total = self._gram.sum(axis=0)
        self._ridge = 1.0 / (samples * _LARGEST**2)
        self._typical = {term: of[0] for term, of in columns.of_term.items()}
        self._comparisons: dict[Term, Comparison] = {}
        self._left: dict[Term, FloatArray] = {}
        self._order = {term: i for i, term in enumerate(columns.of_term)}

    def against_none(self, truth: Term) -> float:
        """Log odds of a law against no change."""
        at = self._typical[truth]
        return expected_log_odds(
            self._comparison(truth), self._gram[:, at, at],
            Size(1, self._columns.parameters[truth]), Size(0, 0),
        )  # fmt: skip

    def odds(self, truth: Term, rival: Term) -> float:
        """Log odds of a law against another one that is fitted to it."""
        if rival not in self._left:
            self._left[rival] = self._imitated_by(rival)
        return expected_log_odds(
            self._comparison(truth), self._left[rival][:, self._order[truth]],
            Size(1, self._columns.parameters[truth]), Size(1, self._columns.parameters[rival]),
        )  # fmt: skip

    def _imitated_by(self, rival: Term) -> FloatArray:
        """(signals, laws) mean squared readings that remain of each law after the rival's fit."""
        own = list(self._columns.of_term[rival])
        truths = list(self._typical.values())
        normal = self._total[np.ix_(own, own)] + self._ridge * np.eye(len(own))
        coefficients = np.linalg.solve(normal, self._total[np.ix_(own, truths)])
        across = self._gram[:, own][:, :, truths]
        within = self._gram[:, own][:, :, own]
        left = (
            self._gram[:, truths, truths]
            - 2.0 * np.einsum("kt,skt->st", coefficients, across)
            + np.einsum("kt,skl,lt->st", coefficients, within, coefficients)
        )
        return np.asarray(np.maximum(left, 0.0))

    def _comparison(self, truth: Term) -> Comparison:
        if truth not in self._comparisons:
            readings = self._columns.matrix[self._typical[truth]]
            signals = np.ones(readings.shape[1])
            self._comparisons[truth] = Comparison.of(readings, signals, [len(readings)], [0], 2)
        return self._comparisons[truth]
