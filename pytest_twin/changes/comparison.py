"""Compare later recordings with earlier ones: is there a change, and which law changed?

A change of a law is scored by its log evidence against no change, with the background marginalized
and the scatter between sessions taken into account. The scatter itself is estimated from few
sessions. So the evidence is reduced twice: earlier sessions are left out in turn and compared with
the others, which shows how much laws seem to change at each joint where nothing did; and the
Gaussian law is replaced by Student's t law with the number of sessions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from pytest_twin.arrays import FloatArray
from pytest_twin.changes.background import Background, Contrast, Information, Rows
from pytest_twin.changes.motor_types import TypeLaw, type_laws
from pytest_twin.changes.scatter import AMPLITUDE_PRIOR, Scatter, SessionSums, scatter_of
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.identification.effort.law_columns import Shape

_MOST_CHANGES = 4
"""Largest number of changes that are named."""
SURE_OF_NAME = 0.5
"""Confidence below which a change has no name."""
_LEAST_PROBABILITY = 0.01
"""Probability below which another law is not listed."""
_TWO_SIDED = 0.975
"""Quantile outside which an amplitude is significant."""


@dataclass(frozen=True)
class Null:
    """Scores where nothing changed: earlier sessions against the others.

    Attributes:
        scores: (sessions,) score of each group of sessions that is left out.
    """

    scores: FloatArray

    def threshold(self, level: float) -> float:
        """Score above which a later session is an alarm at a level, such as 0.05.

        With enough sessions it is a quantile of theirs, else that of a t law; at least 0, below
        which no change is likelier.
        """
        count = len(self.scores)
        if not self.is_t_law(level):
            rank = int(np.ceil((count + 1) * (1.0 - level))) - 1
            return max(float(np.sort(self.scores)[rank]), 0.0)
        spread = float(self.scores.std(ddof=1)) * np.sqrt(1.0 + 1.0 / count)
        return max(float(self.scores.mean() + stdtrit(count - 1, 1.0 - level) * spread), 0.0)

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
        motor: motor type, all of whose joints have this change; None where it is one joint's or the
            robot's.
    """

    shape: Shape
    value: FloatArray
    covariance: FloatArray
    confidence: float
    rivals: Mapping[Term, float]
    gain: float = 0.0
    motor: str | None = None


@dataclass(frozen=True)
class Comparison:
    """Result of a comparison.

    Attributes:
        score: log odds that some law changed in the later recordings.
        threshold: score above which it is an alarm.
        changes: named changes, the largest first.
        is_changed: whether the score is above the threshold.
        background: the laws as the earlier recordings show them.
        before, after: (joints,) RMS residual of the later recordings without and with the changes.
        usual: (joints,) RMS residual of earlier recordings that are left out.
        uncertainty: (joints,) predicted variance of the later efforts, relative to the largest one
            of a session that is left out.
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
    uncertainty: FloatArray


@dataclass(frozen=True)
class Tempering:
    """How much less the evidence is worth than that of a known Gaussian scatter.

    Attributes:
        inflation: (shapes,) mean of twice the gain per amplitude where nothing changed; 1 for a
            scatter that is known.
        freedom: degrees of freedom of the scatter.
    """

    inflation: FloatArray
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

    @property
    def deviations(self) -> float:
        """Standard deviations beyond which an amplitude is significant."""
        return float(stdtrit(self.freedom, _TWO_SIDED))


@dataclass(frozen=True)
class Prepared:
    """What is known before a law is named.

    Attributes:
        contrast: what the later sessions show of a change.
        background: the laws as the earlier sessions show them.
        usual: (joints,) RMS residual of earlier sessions that are left out.
        uncertainty: (joints,) predicted variance of the later efforts, relative to the largest one
            of a session that is left out; above 1 the new motion is an extrapolation.
    """

    contrast: Contrast
    background: Background
    null: Null
    tempering: Tempering
    usual: FloatArray
    uncertainty: FloatArray

    def threshold(self, level: float) -> float:
        """Score above which the later sessions are an alarm at a level, such as 0.05.

        Sessions that are left out show how large a score is where nothing changed, along their own
        motions. The more of the predicted variance they do not show, the nearer is the threshold to
        a bound that holds along every motion: the mean Bayes factor of an unchanged robot exceeds
        1 / level with at most this probability (Markov's inequality).
        """
        left_out = self.null.threshold(level)
        unseen = 1.0 - 1.0 / max(float(self.uncertainty.max()), 1.0)
        return left_out + unseen * max(-float(np.log(level)) - left_out, 0.0)


def prepare(
    rows: Rows,
    sessions: Sequence[Sequence[int]],
    later: Sequence[Sequence[int]],
    shapes: Sequence[Shape],
) -> Prepared:
    """Background, scatter and scores where nothing changed; arguments as of :func:`compare`."""
    earlier_sums = [rows.sums_of(session) for session in sessions]
    later_sums = [rows.sums_of(session) for session in later]
    scatter = [
        scatter_of([each[j] for each in earlier_sums], [each[j] for each in later_sums], size)
        for j, size in enumerate(rows.size)
    ]
    count = len(rows.scale)
    session_information = [Information.of(sums, scatter, count) for sums in earlier_sums]
    background = Background.of(Information.total(session_information))
    shown_later = Information.total([Information.of(sums, scatter, count) for sums in later_sums])
    left_out = []
    others_residuals, variances = [], []
    for group in _groups(len(sessions), len(later)):
        others = Background.of(
            Information.total(
                [info for at, info in enumerate(session_information) if at not in group]
            )
        )
        left_out.append(
            Contrast.of(Information.total([session_information[at] for at in group]), others)
        )
        variances += [_predicted_variance(earlier_sums[at], scatter, others) for at in group]
        for at in group:
            others_residuals += rows.residuals(sessions[at], others.mean)
    freedom = len(sessions) + len(later) - 2
    null, tempering = _null(left_out, shapes, freedom)
    return Prepared(
        Contrast.of(shown_later, background), background, null, tempering,
        np.sqrt(np.mean(np.concatenate(others_residuals) ** 2, axis=0)),
        np.max([_predicted_variance(s, scatter, background) for s in later_sums], axis=0)
        / np.max(variances, axis=0),
    )  # fmt: skip


def _predicted_variance(
    session: Sequence[SessionSums], scatter: Sequence[Scatter], background: Background
) -> FloatArray:
    """(joints,) variance of the efforts of a session as predicted by a background, mean of rows."""
    covariance = np.linalg.inv(background.precision)
    return np.array([
        joint_scatter.noise
        + float(np.sum(covariance[np.ix_(sums.columns, sums.columns)] * sums.matrix)
                + joint_scatter.deviation @ np.diag(sums.matrix)) / max(sums.samples, 1)
        for sums, joint_scatter in zip(session, scatter, strict=True)
    ])  # fmt: skip


def _is_unpredicted(changes: Sequence[Change], unpredicted: NDArray[np.bool_]) -> bool:
    """Whether earlier sessions do not predict each other where these changes act.

    Args:
        unpredicted: (joints,) whether the residual of sessions left out is as large as the effort.
    """
    joints = [change.shape.term.joint for change in changes]
    return any(unpredicted.any() if joint < 0 else unpredicted[joint] for joint in joints)


def _groups(earlier: int, later: int) -> list[list[int]]:
    """Earlier sessions that are left out together, each session equally often.

    They are as many as the later ones, but most earlier sessions remain: the mean of several
    sessions differs less from the others than a single session does.
    """
    size = max(min(later, (earlier - 1) // 2), 1)
    return [[(first + k) % earlier for k in range(size)] for first in range(earlier)]


def compare(
    rows: Rows,
    sessions: Sequence[Sequence[int]],
    later: Sequence[Sequence[int]],
    shapes: Sequence[Shape],
    level: float,
    motors: Mapping[str, Sequence[int]] = MappingProxyType({}),
) -> Comparison:
    """Compare later recordings with earlier ones.

    Args:
        rows: all recordings.
        sessions: earlier recordings of each session; at least three sessions.
        later: the later recordings of each session.
        level: probability of an alarm if nothing changed.
        motors: motor type -> its joints.
    """
    prepared = prepare(rows, sessions, later, shapes)
    background, null, tempering = prepared.background, prepared.null, prepared.tempering
    evidence = evidence_of(prepared.contrast, shapes, tempering)
    score, threshold = tempering.score(shapes, evidence), prepared.threshold(level)
    types = type_laws(shapes, rows.scale, motors)
    changes: list[Change] = []
    new = [i for session in later for i in session]
    changed = background.mean.copy()
    rest = prepared.contrast
    unpredicted = prepared.usual >= rows.size
    for _ in range(_MOST_CHANGES):
        if tempering.score(shapes, evidence) <= threshold:
            break
        named = best_change(rest, shapes, types, tempering, evidence)
        if named[0].confidence < SURE_OF_NAME or _is_unpredicted(named, unpredicted):
            break
        for change in named:
            columns = change.shape.indices
            without = rows.residual_rms(new, changed)
            changed[columns] += change.value
            gain = _gain(rows, columns, without, rows.residual_rms(new, changed))
            changes.append(replace(change, gain=gain))
            rest = rest.without(columns, change.value)
        evidence = evidence_of(rest, shapes, tempering)
    return Comparison(
        score, threshold, tuple(changes), score > threshold, background, null,
        rows.residual_rms(new, background.mean), rows.residual_rms(new, changed),
        prepared.usual, prepared.uncertainty,
    )  # fmt: skip


def _null(
    left_out: Sequence[Contrast], shapes: Sequence[Shape], freedom: int
) -> tuple[Null, Tempering]:
    """Scores of sessions that are left out, and the tempering of later scores."""
    gains = np.array([_gains(contrast, shapes)[0] for contrast in left_out])
    per_amplitude = 2.0 * gains / np.array([len(shape.columns) for shape in shapes])
    joints = np.array([shape.term.joint for shape in shapes])

    def tempering(used: NDArray[np.bool_], freedom: int) -> Tempering:
        inflation = np.ones(len(shapes))
        for joint in np.unique(joints):
            of_joint = joints == joint
            inflation[of_joint] = max(float(per_amplitude[used][:, of_joint].mean()), 1.0)
        return Tempering(inflation, max(freedom, 1))

    every = np.arange(len(left_out))
    scores = []
    for at, contrast in enumerate(left_out):
        of_others = tempering(every != at, freedom - 1)
        scores.append(of_others.score(shapes, evidence_of(contrast, shapes, of_others)))
    return Null(np.array(scores)), tempering(every >= 0, freedom)


def _gains(contrast: Contrast, shapes: Sequence[Shape]) -> tuple[FloatArray, FloatArray]:
    """(shapes,) gain of log-likelihood by a change of each law, and its penalty (Occam factor)."""
    gains, penalties = np.empty(len(shapes)), np.empty(len(shapes))
    amplitudes = np.array([len(shape.columns) for shape in shapes])
    for count in np.unique(amplitudes):
        (which,) = np.nonzero(amplitudes == count)
        columns = np.array([shapes[k].indices for k in which.tolist()])
        precision = contrast.information[columns[:, :, None], columns[:, None, :]]
        precision = precision + np.eye(count) / AMPLITUDE_PRIOR**2
        vector = contrast.vector[columns]
        change = np.linalg.solve(precision, vector[..., None])[..., 0]
        gains[which] = 0.5 * (vector * change).sum(axis=1)
        penalties[which] = 0.5 * np.linalg.slogdet(precision * AMPLITUDE_PRIOR**2)[1]
    return gains, penalties


def evidence_of(contrast: Contrast, shapes: Sequence[Shape], tempering: Tempering) -> FloatArray:
    """(shapes,) log evidence of a change of each law against no change, of equal priors."""
    gains, penalties = _gains(contrast, shapes)
    return np.asarray(gains / tempering.inflation - penalties)


def _estimate(contrast: Contrast, shape: Shape) -> tuple[FloatArray, FloatArray]:
    """(k,) change of the amplitudes of a shape and its (k, k) precision."""
    columns = shape.indices
    precision = contrast.information[np.ix_(columns, columns)]
    precision = precision + np.eye(len(columns)) / AMPLITUDE_PRIOR**2
    change = np.linalg.solve(precision, contrast.vector[columns])
    return np.asarray(change, dtype=np.float64), precision


def best_change(
    contrast: Contrast,
    shapes: Sequence[Shape],
    types: Sequence[TypeLaw],
    tempering: Tempering,
    evidence: FloatArray,
) -> list[Change]:
    """The most probable law in its best shape: one change, or one for each joint of a motor type.

    The gain is not yet known.
    """
    of_types = [law.estimate(contrast, tempering.inflation) for law in types]
    every = np.concatenate([evidence, [estimate[0] for estimate in of_types]])
    terms = [*(shape.term for shape in shapes), *(law.term for law in types)]
    probability = probabilities(terms, every, tempering)
    term = max(probability, key=lambda law: probability[law])
    best = max(
        (k for k, candidate in enumerate(terms) if candidate == term), key=lambda k: float(every[k])
    )
    confidence = probability[term]
    if best >= len(shapes):
        law, (_, value, covariance) = types[best - len(shapes)], of_types[best - len(shapes)]
        changed = [k for k in law.members if evidence[k] > 0.0]
        if len(changed) != 1:
            return _of_type(law, shapes, value, covariance, confidence, _rivals(probability, term))
        # Only one of its joints changed.
        best, replaced = changed[0], term
        term = shapes[best].term
        confidence += probability[term]
        del probability[replaced]
    significant = _significant(contrast, shapes[best], best, tempering)
    simpler = _simplest(shapes, best, significant, evidence)
    if simpler != best:
        best, replaced = simpler, term
        term = shapes[best].term
        if term != replaced:
            confidence += probability[term]
            del probability[replaced]
    value, covariance = _with_covariance(contrast, shapes[best], tempering.inflation[best])
    return [Change(shapes[best], value, covariance, confidence, _rivals(probability, term))]


def _of_type(
    law: TypeLaw,
    shapes: Sequence[Shape],
    value: FloatArray,
    covariance: FloatArray,
    confidence: float,
    rivals: Mapping[Term, float],
) -> list[Change]:
    """The change of each joint of a motor type."""
    parts = np.split(np.arange(len(value)), len(law.members))
    return [
        Change(
            shapes[k], value[part], covariance[np.ix_(part, part)], confidence, rivals,
            motor=law.motor,
        )
        for k, part in zip(law.members, parts, strict=True)
    ]  # fmt: skip


def _significant(
    contrast: Contrast, shape: Shape, at: int, tempering: Tempering
) -> NDArray[np.bool_]:
    """(k,) whether each amplitude of a shape differs from 0.

    Args:
        at: index of the shape.
    """
    value, covariance = _with_covariance(contrast, shape, tempering.inflation[at])
    return np.asarray(np.abs(value) > tempering.deviations * np.sqrt(np.diag(covariance)))


def _rivals(probability: Mapping[Term, float], term: Term) -> dict[Term, float]:
    """Other laws that are not improbable."""
    return {
        law: p
        for law, p in sorted(probability.items(), key=lambda each: -each[1])[:6]
        if law != term and p >= _LEAST_PROBABILITY
    }


def probabilities(
    terms: Sequence[Term], evidence: FloatArray, tempering: Tempering
) -> dict[Term, float]:
    """Law -> its probability among all laws and no change.

    A law with many shapes is not likelier because of them.

    Args:
        terms: law of each shape.
        evidence: (shapes,) log evidence against no change.
    """
    of_law = tempering.by_law(terms, evidence)
    log_odds = np.array([*of_law.values(), 0.0])
    share = np.exp(log_odds - np.logaddexp.reduce(log_odds))
    return dict(zip(of_law, share[:-1].tolist(), strict=True))


def _with_covariance(
    contrast: Contrast, shape: Shape, inflation: float
) -> tuple[FloatArray, FloatArray]:
    value, precision = _estimate(contrast, shape)
    return value, np.asarray(inflation * np.linalg.inv(precision), dtype=np.float64)


def _gain(rows: Rows, columns: NDArray[np.intp], before: FloatArray, after: FloatArray) -> float:
    """Share of the squared residual that a change removes, joints on which it acts alike."""
    acts = [bool(np.isin(columns, sums.columns).any()) for sums in rows.sums[0]]
    seen = np.array(acts) & (before > 0.0)
    return 1.0 - float(np.mean((after[seen] / before[seen]) ** 2)) if seen.any() else 0.0


def _simplest(
    shapes: Sequence[Shape], best: int, significant: NDArray[np.bool_], scores: FloatArray
) -> int:
    """Index of the law that has the significant amplitudes of a shape and fewer others.

    Dry friction alone instead of Stribeck friction without a significant stiction, for example.
    """
    columns = set(shapes[best].indices.tolist())
    needed = set(shapes[best].indices[significant].tolist())
    simpler = [
        k for k, shape in enumerate(shapes)
        if needed and needed <= set(shape.indices.tolist()) < columns
    ]  # fmt: skip
    return max(simpler, key=lambda k: float(scores[k]), default=best)
