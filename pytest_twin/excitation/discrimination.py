"""How well a motion tells two hypotheses apart (T-optimality).

The criterion is the smallest squared difference between the readings of one hypothesis, taken for
true, and those of the other over all its parameters (Atkinson, Fedorov, Biometrika 62, 1975).
Either hypothesis is taken for true in turn, and the smaller of the two counts: the truth is not
known before the measurement. The odds are those that a diagnosis gives for such a difference: the
variance of each signal is profiled out, and correlated samples count once (see
``estimation.comparison``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.estimation.comparison import Comparison, Size
from pytest_twin.estimation.hypothesis import Hypothesis
from pytest_twin.estimation.least_squares import FittedModel, fit
from pytest_twin.estimation.score import NOISE_FLOORS
from pytest_twin.excitation.hypotheses import Rival
from pytest_twin.excitation.responses import Responses

_STARTS = 3
"""Number of starts of a fit that are refined, those with the smallest difference."""
_ITERATIONS = 5
"""Largest number of steps of a fit."""
_BEYOND_DOUBT = 7.0
"""Logarithm of odds of 1,000 to 1. More odds for one hypothesis are worth no less for the other."""
_REPEATS = 0.25
"""Mean squared difference, in multiples of the noise's variance, up to which a law repeats another
one. A diagnosis takes predictions as equal up to half a noise floor."""


@dataclass(frozen=True)
class Imitation:
    """One hypothesis taken for true, and the other one fitted to its readings along one motion.

    Attributes:
        truth, rival: with their parameters.
        difference: (n, signals) readings of the truth minus those of the rival, in standard
            deviations of the noise.
        effect: (n, signals) readings of the truth minus those of the nominal model.
    """

    truth: Hypothesis
    rival: Hypothesis
    difference: FloatArray
    effect: FloatArray

    @property
    def criterion(self) -> float:
        """Sum of squared differences; 0 where a simulation diverged."""
        value = float((self.difference**2).sum())
        return value if np.isfinite(value) else 0.0

    @property
    def log_odds(self) -> float:
        """Expected logarithm of the odds of the truth against the rival, of equal prior odds."""
        signals = self.difference.shape[1]
        if not np.isfinite(self.difference).all() or not np.isfinite(self.effect).all():
            return 0.0
        comparison = Comparison.of(self.effect, np.ones(signals), [len(self.effect)], [0], 2)
        return expected_log_odds(
            comparison, np.mean(self.difference**2, axis=0), Size(1, self.truth.free_count),
            Size(1, self.rival.free_count),
        )  # fmt: skip


def expected_log_odds(
    comparison: Comparison, difference: FloatArray, truth: Size, rival: Size
) -> float:
    """Expected logarithm of the odds of a truth against its imitation, of equal prior odds.

    Args:
        comparison: noise of 1 and independent samples of the readings.
        difference: (signals,) mean squared difference, in variances of the noise.
        truth, rival: their numbers of effects and parameters.
    """
    # Both leave the noise of the measurement, whose variance is 1.
    return (
        comparison.log_likelihood(np.ones(len(difference)), NOISE_FLOORS)
        - comparison.log_likelihood(1.0 + difference, NOISE_FLOORS)
        - comparison.penalty(truth)
        + comparison.penalty(rival)
    )


@dataclass(frozen=True)
class Separation:
    """How well one motion tells two hypotheses apart.

    Attributes:
        imitations: the first taken for true and imitated by the second, and the reverse.
    """

    imitations: tuple[Imitation, Imitation]

    @property
    def log_odds(self) -> float:
        """Expected logarithm of the odds for the hypothesis that is true, the smaller of both."""
        return min(one.log_odds for one in self.imitations)

    @property
    def rank(self) -> tuple[float, float]:
        """Larger for a better motion: the smaller of both odds, while they are not beyond doubt."""
        both = [one.log_odds for one in self.imitations]
        return min(*both, _BEYOND_DOUBT), sum(min(one, 4.0 * _BEYOND_DOUBT) for one in both)

    @property
    def probability(self) -> float:
        """Expected probability of the hypothesis that is true."""
        return float(1.0 / (1.0 + np.exp(-np.clip(self.log_odds, -700.0, 700.0))))


@dataclass(frozen=True, slots=True)
class _OfCase(Hypothesis):
    """A hypothesis that is fitted to one case: one truth along one motion."""

    case: int = 0

    def with_theta(self, theta: FloatArray) -> _OfCase:
        return _OfCase(self.terms, theta, self.case)


@dataclass(frozen=True)
class _Cases:
    """Readings of a truth along a motion, for each case; the residuals of a fit to them."""

    responses: Responses
    motions: Sequence[int]
    readings: Sequence[FloatArray]

    def residuals(
        self, hypotheses: Sequence[Hypothesis], segments: NDArray[np.int64]
    ) -> list[FloatArray]:
        """(n, signals) truth minus prediction, in standard deviations of the noise."""
        del segments
        cases = [one.case if isinstance(one, _OfCase) else 0 for one in hypotheses]
        predicted = self.responses.of(
            [(self.motions[case], one) for case, one in zip(cases, hypotheses, strict=True)]
        )
        return [self.readings[case] - one for case, one in zip(cases, predicted, strict=True)]


def imitate(
    responses: Responses,
    cases: Sequence[tuple[int, Hypothesis]],
    starts: Sequence[Sequence[Hypothesis]],
) -> list[Imitation]:
    """Fit a rival to the readings of a truth, for each case.

    Args:
        cases: a motion and the truth along it.
        starts: parameters from which the rival's fit to each case begins.
    """
    motions = [motion for motion, _ in cases]
    readings, nominal = responses.of(cases), responses.nominal()
    problem = _Cases(responses, motions, readings)
    every = [
        _OfCase(start.terms, start.theta, case)
        for case, of_case in enumerate(starts)
        for start in of_case
    ]
    nowhere = np.zeros(0, dtype=np.int64)
    cost = [sum_of_squares(r) for r in problem.residuals(every, nowhere)]
    chosen: list[_OfCase] = []
    for case in range(len(cases)):
        of_case = [i for i, one in enumerate(every) if one.case == case]
        chosen += [every[i] for i in sorted(of_case, key=lambda i: cost[i])[:_STARTS]]
    signals = np.ones(len(responses.floor))
    fitted = fit(problem, chosen, signals, nowhere, iterations=_ITERATIONS, slopes=False)
    best: dict[int, FittedModel] = {}
    for start, model in zip(chosen, fitted, strict=True):
        if start.case not in best or model.cost < best[start.case].cost:
            best[start.case] = model
    return [
        Imitation(
            truth, _plain(best[case].hypothesis), best[case].residual,
            readings[case] - nominal[motion],
        )
        for case, (motion, truth) in enumerate(cases)
    ]  # fmt: skip


def separations(
    responses: Responses, rivals: tuple[Rival, Rival], truths: tuple[Hypothesis, Hypothesis]
) -> list[Separation]:
    """How well each motion tells two hypotheses apart.

    Args:
        truths: parameters of each that are taken for true.
    """
    count = len(responses.motions)
    starts = [[*rival.starts(responses.scales), truth]
              for rival, truth in zip(rivals, truths, strict=True)]  # fmt: skip
    cases = [(motion, truth) for truth in truths for motion in range(count)]
    imitations = imitate(responses, cases, [starts[1]] * count + [starts[0]] * count)
    return [Separation((imitations[i], imitations[count + i])) for i in range(count)]


def truths_of(responses: Responses, rivals: tuple[Rival, Rival]) -> tuple[Hypothesis, Hypothesis]:
    """Parameters of each hypothesis that are taken for true.

    They are those of a diagnosis, else typical ones. A hypothesis without parameters of a diagnosis
    imitates the other one, because a motion has to distinguish similar laws; a law that contains
    the other one would only repeat it, and is taken with its own typical parameters.
    """
    first, second = rivals
    if second.diagnosed and not first.diagnosed:
        return truths_of(responses, (second, first))[::-1]
    truth = first.assumed(responses.scales)
    if second.diagnosed:
        return truth, second.assumed(responses.scales)
    count = len(responses.motions)
    starts = second.starts(responses.scales)
    imitations = imitate(responses, [(i, truth) for i in range(count)], [starts] * count)
    if all(repeats(one) for one in imitations):
        return truth, second.assumed(responses.scales)
    # The motion along which the first hypothesis shows most determines the second best.
    most = max(imitations, key=lambda one: sum_of_squares(one.effect))
    return truth, most.rival


def _plain(hypothesis: Hypothesis) -> Hypothesis:
    return Hypothesis(hypothesis.terms, hypothesis.theta)


def repeats(imitation: Imitation) -> bool:
    """Whether a law repeats the readings of the other one to within the noise."""
    return float((imitation.difference**2).mean(axis=0).max()) < _REPEATS


def sum_of_squares(values: FloatArray) -> float:
    """Sum of squares; infinite where a simulation diverged."""
    total = float((values**2).sum())
    return total if np.isfinite(total) else np.inf
