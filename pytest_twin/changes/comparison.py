"""Compare later recordings with earlier ones: is there a change, and which law changed?

Every earlier session is left out in turn and compared with the others as if it were later. This
gives, for this robot, how much each law seems to change where nothing did (its drift), and how
large the best score then is. A later session is an alarm if its best score is above these.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from pytest_twin.arrays import FloatArray
from pytest_twin.changes.background import Background, Remainder, Rows, background_of
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.law_columns import Shape

_SAMPLES = 50.0
"""Independent samples of a joint. What a model leaves of an effort is model error more than noise,
and does not average out: a longer recording is not more evidence (Kish, Survey Sampling, 1965)."""
_PENALTY = 0.5 * np.log(3.0 * _SAMPLES)
"""Penalty of an amplitude, half the logarithm of the number of samples (BIC)."""
_MOST_CHANGES = 4
"""Largest number of changes that are named."""
SURE_OF_NAME = 0.5
"""Confidence below which a change has no name."""


@dataclass(frozen=True)
class Null:
    """Differences where nothing changed: each earlier session against the others.

    Attributes:
        scores: (sessions,) best score of each.
        drift: for each shape, (k, k) mean square of the amplitudes that seem to change.
    """

    scores: FloatArray
    drift: tuple[FloatArray, ...]

    def threshold(self, level: float) -> float:
        """Score above which a later session is an alarm at a level, such as 0.05.

        With enough sessions it is a quantile of theirs, else that of a t law.
        """
        count = len(self.scores)
        if not self.is_t_law(level):
            rank = int(np.ceil((count + 1) * (1.0 - level))) - 1
            return float(np.sort(self.scores)[rank])
        spread = float(self.scores.std(ddof=1)) * np.sqrt(1.0 + 1.0 / count)
        return float(self.scores.mean() + stdtrit(count - 1, 1.0 - level) * spread)

    def is_t_law(self, level: float) -> bool:
        """Whether there are too few sessions for a quantile."""
        return (len(self.scores) + 1) * level < 1.0

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the t law."""
        return len(self.scores) - 1


@dataclass(frozen=True)
class Change:
    """A law whose amplitudes changed.

    Attributes:
        shape: the law, its joint and its shape.
        value: (k,) change of each amplitude, relative to the RMS effort.
        covariance: (k, k) its covariance.
        confidence: probability of the law among all laws and no change.
        rivals: other laws -> their probability.
        gain: share of the squared residual that the change removes, all joints weighted equally.
    """

    shape: Shape
    value: FloatArray
    covariance: FloatArray
    confidence: float
    rivals: Mapping[Term, float]
    gain: float


@dataclass(frozen=True)
class Comparison:
    """Result of a comparison.

    Attributes:
        score: best score of the later recordings.
        threshold: score above which it is an alarm.
        changes: named changes, the largest first.
        is_changed: whether the score is above the threshold.
        background: the laws as the earlier recordings show them.
        before, after: (joints,) RMS residual of the later recordings without and with the changes.
        usual: (joints,) RMS residual of earlier recordings that are left out.
    """

    score: float
    threshold: float
    changes: tuple[Change, ...]
    is_changed: bool
    background: Background
    null: Null
    before: FloatArray
    after: FloatArray
    usual: FloatArray


def compare(
    rows: Rows,
    sessions: Sequence[Sequence[int]],
    later: Sequence[Sequence[int]],
    shapes: Sequence[Shape],
    level: float,
    widening: float = 1.0,
) -> Comparison:
    """Compare later recordings with earlier ones.

    Args:
        rows: all recordings.
        sessions: earlier recordings of each session; at least three sessions.
        later: the later recordings of each session.
        level: probability of an alarm if nothing changed.
        widening: factor on drift and threshold, for motions that the earlier ones do not cover.
    """
    background = background_of(rows, sessions)
    null, usual = _null(rows, sessions, background, shapes)
    # Means of several sessions drift less.
    share = widening**2 * (1.0 / len(later) + 1.0 / len(sessions))
    remainder = Remainder.of(rows, [i for session in later for i in session], background)
    unknown = remainder.seeming_covariances(shapes, background.covariance())
    drift = tuple(share * own + more for own, more in zip(null.drift, unknown, strict=True))
    first = _scores(remainder, shapes, drift)
    score, threshold = float(first.max()), widening * max(null.threshold(level), 0.0)
    changes: list[Change] = []
    rest, scores = remainder, first
    while scores.max() > threshold and len(changes) < _MOST_CHANGES:
        change = _best_change(rest, shapes, drift, scores)
        if change.confidence < SURE_OF_NAME:
            break
        changes.append(change)
        rest = rest.after(change.shape.indices, change.value)
        scores = _scores(rest, shapes, drift)
    return Comparison(
        score, threshold, tuple(changes), score > threshold, background, null,
        np.sqrt(remainder.power / remainder.samples), np.sqrt(rest.power / rest.samples), usual,
    )  # fmt: skip


def _null(
    rows: Rows, sessions: Sequence[Sequence[int]], background: Background, shapes: Sequence[Shape]
) -> tuple[Null, FloatArray]:
    """Compare each session with the others; also (joints,) RMS residual of sessions left out."""
    left_out, unknown = [], []
    for session in sessions:
        others = background.without(rows, session)
        remainder = Remainder.of(rows, session, others)
        left_out.append(remainder)
        unknown.append(remainder.seeming_covariances(shapes, others.covariance()))
    squares = []
    for remainder in left_out:
        seeming = [remainder.fit(shape.indices)[0] for shape in shapes]
        squares.append([np.outer(value, value) for value in seeming])
    total = [np.sum(own, axis=0) for own in zip(*squares, strict=True)]
    count = len(sessions)
    scores = []
    share = (1.0 + 1.0 / (count - 1)) / (count - 1)
    for remainder, own, more in zip(left_out, squares, unknown, strict=True):
        drift = [share * (t - o) + u for t, o, u in zip(total, own, more, strict=True)]
        scores.append(float(_scores(remainder, shapes, drift).max()))
    samples = sum(remainder.samples for remainder in left_out)
    power = np.sum([remainder.power for remainder in left_out], axis=0)
    null = Null(np.array(scores), tuple(t / count for t in total))
    return null, np.sqrt(power / samples)


def _scores(
    remainder: Remainder, shapes: Sequence[Shape], drift: Sequence[FloatArray]
) -> FloatArray:
    """(shapes,) log odds of a change of each law against no change, of equal priors.

    The gain is that of the profiled noise of each joint, and is reduced by the share of the change
    that the law's drift explains.
    """
    log_odds = np.empty(len(shapes))
    for at, (shape, law_drift) in enumerate(zip(shapes, drift, strict=True)):
        columns = shape.indices
        change, information = remainder.fit(columns)
        after = remainder.power_after(columns, change)
        gain = 0.5 * _SAMPLES * float(np.log(remainder.power / after).sum())
        covariance = np.linalg.inv(information) / _SAMPLES
        square = float(change @ np.linalg.solve(covariance, change))
        with_drift = float(change @ np.linalg.solve(covariance + law_drift, change))
        log_odds[at] = gain * with_drift / max(square, 1e-300) - _PENALTY * len(columns)
    return log_odds


def _best_change(
    remainder: Remainder,
    shapes: Sequence[Shape],
    drift: Sequence[FloatArray],
    scores: FloatArray,
) -> Change:
    """The most probable law, in its best shape."""
    odds: dict[Term, float] = {}
    count: dict[Term, int] = {}
    for shape, score in zip(shapes, scores, strict=True):
        odds[shape.term] = float(np.logaddexp(odds.get(shape.term, -np.inf), score))
        count[shape.term] = count.get(shape.term, 0) + 1
    # A law with many shapes is not likelier because of them.
    log_odds = np.array([odds[term] - np.log(count[term]) for term in odds])
    every = np.append(log_odds, 0.0)
    share = np.exp(every - np.logaddexp.reduce(every))
    probability = dict(zip(odds, share[:-1].tolist(), strict=True))
    term = max(probability, key=lambda one: probability[one])
    at = max(
        (k for k, shape in enumerate(shapes) if shape.term == term), key=lambda k: float(scores[k])
    )
    value, own = _estimate(remainder, shapes[at], drift[at])
    simpler = _simplest(shapes, at, np.abs(value) > Z95 * np.sqrt(np.diag(own)), scores)
    confidence = probability[term]
    if simpler != at:
        at, replaced = simpler, term
        term = shapes[at].term
        value, own = _estimate(remainder, shapes[at], drift[at])
        if term != replaced:
            confidence += probability[term]
            del probability[replaced]
    columns = shapes[at].indices
    after = remainder.power_after(columns, value)
    acted = (remainder.matrix[:, columns, columns] > 0.0).any(axis=1)
    gain = 1.0 - float(np.mean(after[acted] / remainder.power[acted])) if acted.any() else 0.0
    rivals = {
        one: p
        for one, p in sorted(probability.items(), key=lambda each: -each[1])[:6]
        if one != term and p >= 0.01
    }
    return Change(shapes[at], value, own, confidence, rivals, gain)


def _estimate(
    remainder: Remainder, shape: Shape, drift: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(k,) change of the amplitudes of a shape and its (k, k) covariance."""
    value, information = remainder.fit(shape.indices)
    return value, np.linalg.inv(information) / _SAMPLES + drift


def _simplest(
    shapes: Sequence[Shape], at: int, significant: NDArray[np.bool_], scores: FloatArray
) -> int:
    """Index of the law that has the significant amplitudes of a shape and fewer others.

    Dry friction alone instead of Stribeck friction without a significant stiction, for example.
    """
    own = set(shapes[at].indices.tolist())
    needed = set(shapes[at].indices[significant].tolist())
    simpler = [
        k for k, shape in enumerate(shapes)
        if needed and needed <= set(shape.indices.tolist()) < own
    ]  # fmt: skip
    return max(simpler, key=lambda k: float(scores[k]), default=at)
