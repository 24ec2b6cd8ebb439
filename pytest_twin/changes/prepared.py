"""What is known before a law is named: background, scatter, and scores where nothing changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from pytest_twin.arrays import FloatArray
from pytest_twin.changes.background import Background, Contrast, Information, Rows
from pytest_twin.changes.evidence import TWO_SIDED, SeemingChanges, Tempering, evidence_of
from pytest_twin.changes.scatter import Scatter, SessionSums, scatter_of
from pytest_twin.identification.effort.law_columns import Shape

_LEAST_ACCURACY = 0.03
"""Smallest share of an effort that laws leave. Slow motions show less than geometry and the filter
leave at the reversals of fast ones. On an arm whose motion is five times as large and as fast as
before, no name was wrong from 0.03 to 0.1. Dry friction times three was named in 2, 2 and 0 of 3
cases at 0.03, 0.05 and 0.1."""
_UNLIKE_SHARE = 0.2
"""Share of the alarm level for efforts that no law describes."""


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
class Prepared:
    """What is known before a law is named.

    Attributes:
        scatter: scatter of each joint.
        later: for each later session, its sums for each joint.
        background: the laws as the earlier sessions show them.
        left_out: (sessions, joints) RMS residual of each earlier session that is left out.
        accuracy: (joints,) share of the RMS effort that all laws together leave of the earlier
            sessions, and so the share of a change that its law leaves.
        uncertainty: (joints,) predicted variance of the later efforts, relative to the largest one
            of a session that is left out; above 1 the new motion is an extrapolation.
        undescribed: (sessions, joints) variance that all laws together leave of each earlier
            session, relative to the noise.
        undescribed_now: (joints,) that of the later sessions.
    """

    scatter: tuple[Scatter, ...]
    later: Sequence[Sequence[SessionSums]]
    background: Background
    null: Null
    tempering: Tempering
    left_out: FloatArray
    accuracy: FloatArray
    uncertainty: FloatArray
    undescribed: FloatArray
    undescribed_now: FloatArray

    def contrasts(self, change: FloatArray) -> tuple[Contrast, Contrast]:
        """What the later sessions show of a change: for the alarm, and for the name of the law.

        What no law describes has a larger dispersion (McCullagh, Nelder, Generalized Linear Models,
        1989, ch. 9), and supports no name. For the alarm it is a change, except along motions whose
        laws the earlier sessions do not show either. Laws that differ by less than their accuracy
        share a change.

        Args:
            change: (joints,) RMS residual of the later recordings beside the background.
        """
        of_laws = self._of_laws(change)
        undescribed = self._newly_undescribed(of_laws)
        lack = np.maximum(undescribed / _upper_bound(self.undescribed, TWO_SIDED), 1.0)
        return (
            self._contrast(lack ** _unseen(self.uncertainty)),
            self._contrast(np.maximum(lack, 1.0 + of_laws)),
        )

    def _of_laws(self, change: FloatArray) -> FloatArray:
        """(joints,) variance that the law of a change leaves itself, relative to the noise."""
        added = np.maximum(change**2 - self.usual**2, 0.0)
        return np.asarray(self.accuracy**2 * added / np.array([one.noise for one in self.scatter]))

    def _newly_undescribed(self, of_laws: FloatArray) -> FloatArray:
        return np.maximum(self.undescribed_now - of_laws, np.finfo(float).tiny)

    def _contrast(self, dispersion: FloatArray) -> Contrast:
        wider = [
            Scatter(one.noise * factor, one.deviation * factor)
            for one, factor in zip(self.scatter, dispersion, strict=True)
        ]
        count = len(self.background.mean)
        later = [Information.of(sums, wider, count) for sums in self.later]
        return Contrast.of(Information.total(later), self.background)

    def unlike(self, level: float, change: FloatArray) -> NDArray[np.bool_]:
        """(joints,) whether the later efforts have a part that no law describes and that is new.

        It is rare by itself, so that it adds little to the level of the alarm. Along a motion that
        the earlier sessions predict less precisely, it must be larger by as much.
        """
        quantile = 1.0 - _UNLIKE_SHARE * level / self.undescribed.shape[1]
        bound = _upper_bound(self.undescribed, quantile) * np.maximum(self.uncertainty, 1.0)
        return np.asarray(self._newly_undescribed(self._of_laws(change)) > bound)

    @property
    def usual(self) -> FloatArray:
        """(joints,) RMS residual of earlier sessions that are left out."""
        return np.asarray(np.sqrt(np.mean(self.left_out**2, axis=0)))

    @property
    def expected(self) -> FloatArray:
        """(joints,) RMS residual of an unchanged robot along the later motion, above 0."""
        return np.asarray(np.maximum(self.usual * self._wider, np.finfo(float).tiny))

    @property
    def _wider(self) -> FloatArray:
        """(joints,) how much larger residuals may be along the later motion than usual."""
        return np.asarray(np.sqrt(np.maximum(self.uncertainty, 1.0)))

    def rest(self, before: FloatArray, after: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(joints,) significant additional squared residual after and before the changes.

        Both are relative to that of earlier sessions. The first is 0 where the residual is not
        larger than that of an earlier session may be: its logarithm has a t law. Along a motion
        that the earlier recordings predict less precisely, it may be larger by as much.

        Args:
            before, after: (joints,) RMS residual of the later sessions without and with changes.
        """
        bound = _upper_bound(self.left_out, TWO_SIDED) * self._wider
        left = np.where(after > bound, (after / self.expected) ** 2 - 1.0, 0.0)
        added = np.maximum((before / self.expected) ** 2 - 1.0, 0.0)
        return np.maximum(left, 0.0), added

    def threshold(self, level: float) -> float:
        """Score above which the later sessions are an alarm at a level, such as 0.05.

        Sessions that are left out show how large a score is where nothing changed, along their own
        motions. The more of the predicted variance they do not show, the nearer is the threshold to
        a bound that holds along every motion: the mean Bayes factor of an unchanged robot exceeds
        1 / level with at most this probability (Markov's inequality).
        """
        left_out = self.null.threshold(level)
        return left_out + float(_unseen(self.uncertainty).max()) * max(
            -float(np.log(level)) - left_out, 0.0
        )


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
    left_out = []
    residuals: list[list[FloatArray]] = [[] for _ in sessions]
    variances = []
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
            residuals[at] += rows.residuals(sessions[at], others.mean)
    freedom = len(sessions) + len(later) - 2
    null, tempering = _null(left_out, shapes, freedom)
    uncertainty = np.max(
        [_predicted_variance(sums, scatter, background) for sums in later_sums], axis=0
    ) / np.max(variances, axis=0)
    residual = np.array([np.sqrt(np.mean(np.concatenate(each) ** 2, axis=0)) for each in residuals])
    undescribed = _undescribed(earlier_sums, scatter)
    noise = np.array([one.noise for one in scatter])
    left = np.sqrt(noise * undescribed.mean(axis=0)) / _rms_effort(earlier_sums)
    return Prepared(
        tuple(scatter), later_sums, background, null, tempering, residual,
        np.clip(left, _LEAST_ACCURACY, 1.0), uncertainty, undescribed,
        _undescribed(later_sums, scatter).mean(axis=0),
    )  # fmt: skip


def _rms_effort(sessions: Sequence[Sequence[SessionSums]]) -> FloatArray:
    """(joints,) RMS effort of sessions, N*m or N."""
    power = np.array([[sums.power / max(sums.samples, 1) for sums in one] for one in sessions])
    return np.asarray(np.sqrt(np.maximum(power.mean(axis=0), np.finfo(float).tiny)))


def _unseen(uncertainty: FloatArray) -> FloatArray:
    """(joints,) share of the predicted variance that sessions left out do not show."""
    return np.asarray(1.0 - 1.0 / np.maximum(uncertainty, 1.0))


def _upper_bound(values: FloatArray, quantile: float) -> FloatArray:
    """(joints,) value that another session rarely exceeds: the logarithms have a t law.

    Args:
        values: (sessions, joints) positive values of the earlier sessions.
    """
    count = len(values)
    logs = np.log(np.maximum(values, np.finfo(float).tiny))
    spread = logs.std(axis=0, ddof=1) * np.sqrt(1.0 + 1.0 / count)
    return np.asarray(np.exp(logs.mean(axis=0) + stdtrit(count - 1, quantile) * spread))


def _undescribed(
    sessions: Sequence[Sequence[SessionSums]], scatter: Sequence[Scatter]
) -> FloatArray:
    """(sessions, joints) variance that all laws leave of each session, relative to the noise."""
    return np.array([
        [of_joint.lack_of_fit(sums) for sums, of_joint in zip(session, scatter, strict=True)]
        for session in sessions
    ])  # fmt: skip


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


def _groups(earlier: int, later: int) -> list[list[int]]:
    """Earlier sessions that are left out together, each session equally often.

    They are as many as the later ones, but most earlier sessions remain: the mean of several
    sessions differs less from the others than a single session does.
    """
    size = max(min(later, (earlier - 1) // 2), 1)
    return [[(first + k) % earlier for k in range(size)] for first in range(earlier)]


def _null(
    left_out: Sequence[Contrast], shapes: Sequence[Shape], freedom: int
) -> tuple[Null, Tempering]:
    """Scores of sessions that are left out, and the tempering of later scores."""
    seeming = SeemingChanges.of(left_out, shapes)
    scores = []
    for at, contrast in enumerate(left_out):
        of_others = Tempering(seeming.inflation(without=at), max(freedom - 1, 1))
        evidence = evidence_of(contrast, shapes, of_others.inflation)
        scores.append(of_others.score(shapes, evidence))
    return Null(np.array(scores)), Tempering(seeming.inflation(), max(freedom, 1))
