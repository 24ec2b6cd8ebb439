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

from pytest_twin.arrays import FloatArray
from pytest_twin.changes.background import Background, Rows
from pytest_twin.changes.evidence import evidence_of
from pytest_twin.changes.motor_types import type_laws
from pytest_twin.changes.naming import LEAST_PROBABILITY, Candidate, Change, Naming, best_possible
from pytest_twin.changes.prepared import Null, Prepared, prepare
from pytest_twin.identification.effort.law_columns import Shape

_MOST_CHANGES = 4
"""Largest number of changes that are named."""
SURE_OF_NAME = 0.5
"""Confidence below which a change has no name."""


@dataclass(frozen=True)
class Comparison:
    """Result of a comparison.

    Attributes:
        score: log odds that some law changed in the later recordings.
        threshold: score above which it is an alarm.
        changes: named changes, the largest first.
        candidates: the explanations between which the recordings do not decide, the most probable
            first; empty where a change is named, the score is no alarm, or the first explains
            nothing of what is new at its joints: then it names no joint either.
        explained: share of what is new at its joints that the first candidate explains; 1 without.
        is_changed: whether the score is above the threshold, or a joint is unlike before.
        background: the laws as the earlier recordings show them.
        before, after: (joints,) RMS residual of the later recordings without and with the changes.
        usual: (joints,) RMS residual of earlier recordings that are left out.
        uncertainty: (joints,) predicted variance of the later efforts, relative to the largest one
            of a session that is left out.
        unlike: (joints,) whether the later efforts have a new part that no law describes.
    """

    score: float
    threshold: float
    changes: tuple[Change, ...]
    candidates: tuple[Candidate, ...]
    explained: float
    is_changed: bool
    background: Background
    null: Null
    before: FloatArray
    after: FloatArray
    usual: FloatArray
    uncertainty: FloatArray
    unlike: NDArray[np.bool_]


def is_unpredicted(changes: Sequence[Change], prepared: Prepared, size: FloatArray) -> bool:
    """Whether earlier sessions do not predict each other where these changes act.

    Args:
        size: (joints,) RMS effort of the earlier recordings.
    """
    unpredicted = prepared.usual >= size
    joints = [change.shape.term.joint for change in changes]
    return any(unpredicted.any() if joint < 0 else unpredicted[joint] for joint in joints)


def _is_named(named: Sequence[Change], changes: Sequence[Change]) -> bool:
    """Whether the rest is most like a law that is named already, in another shape.

    A law changes once; what it leaves in its own shape is no second change of it.
    """
    return not {change.shape.term for change in named}.isdisjoint(
        change.shape.term for change in changes
    )


def _is_inaccuracy(
    rows: Rows,
    later: Sequence[int],
    named: Sequence[Change],
    changes: Sequence[Change],
    accuracy: FloatArray,
) -> bool:
    """Whether further changes are no larger than what named ones leave of their own effort.

    Args:
        accuracy: (joints,) share of an effort that laws leave.
    """

    own, of_all = (_rms_effort(rows, later, each) for each in (named, changes))
    return bool(np.all(own <= accuracy * of_all))


def _amplitudes(rows: Rows, changes: Sequence[Change]) -> FloatArray:
    """(columns,) sum of changes, relative to the RMS effort."""
    amplitudes = np.zeros(len(rows.scale))
    for change in changes:
        amplitudes[change.shape.indices] += change.value
    return amplitudes


def _rms_effort(rows: Rows, later: Sequence[int], changes: Sequence[Change]) -> FloatArray:
    """(joints,) RMS effort of changes along later recordings, N*m or N."""
    amplitudes = _amplitudes(rows, changes)
    every = np.concatenate([rows.effort_of(i, amplitudes) for i in later])
    return np.asarray(np.sqrt(np.mean(every**2, axis=0)))


def _explained_share(own: FloatArray, left: FloatArray, added: FloatArray) -> float:
    """Share of the additional residual that is gone where a change acts.

    A law that leaves a significant rest is not the law that changed, or not the only one: only the
    share that it explains supports its name. A joint counts by the share of its additional residual
    that the effort of the change has: what is new at a joint that the change hardly moves is no
    evidence about it.

    Args:
        own: (joints,) squared effort of the change, relative to the residual that is expected.
        left, added: (joints,) significant additional squared residual after and before the changes,
            relative to the same.
    """
    weight = np.minimum(own / np.maximum(added, np.finfo(float).tiny), 1.0)
    whole = float(weight @ added)
    return 1.0 - min(float(weight @ left) / whole, 1.0) if whole > 0.0 else 1.0


def _explained_shares(
    rows: Rows,
    later: Sequence[int],
    prepared: Prepared,
    changes: Sequence[Change],
    before: FloatArray,
) -> list[float]:
    """Share of the additional residual that all changes explain where each of them acts.

    Args:
        before: (joints,) RMS residual of the later recordings without the changes.
    """
    changed = prepared.background.mean + _amplitudes(rows, changes)
    left, added = prepared.rest(before, rows.residual_rms(later, changed))
    return [
        _explained_share((_rms_effort(rows, later, [change]) / prepared.expected) ** 2, left, added)
        for change in changes
    ]


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
    new = [i for session in later for i in session]
    before = rows.residual_rms(new, background.mean)
    rest, naming = prepared.contrasts(before)
    evidence = evidence_of(rest, shapes, tempering.inflation)
    score, threshold = tempering.score(shapes, evidence), prepared.threshold(level)
    types = type_laws(shapes, rows.scale, motors)
    changes: list[Change] = []
    first: Naming | None = None
    changed = background.mean.copy()
    for _ in range(_MOST_CHANGES):
        if tempering.score(shapes, evidence) <= threshold:
            break
        best = best_possible(naming, shapes, types, tempering, rows, background)
        named = best.changes
        if is_unpredicted(named, prepared, rows.size):
            break
        first = first or best
        if named[0].confidence < SURE_OF_NAME:
            break
        if changes and (
            _is_named(named, changes)
            or _is_inaccuracy(rows, new, named, changes, prepared.accuracy)
        ):
            break
        for change in named:
            columns = change.shape.indices
            without = rows.residual_rms(new, changed)
            changed[columns] += change.value
            gain = _gain(rows, columns, without, rows.residual_rms(new, changed))
            changes.append(replace(change, gain=gain))
            rest = rest.without(columns, change.value)
            naming = naming.without(columns, change.value)
        evidence = evidence_of(rest, shapes, tempering.inflation)
    fitted = changes or ([] if first is None else first.changes)
    share = _explained_shares(rows, new, prepared, fitted, before)
    changes = [
        replace(change, confidence=change.confidence * each)
        for change, each in zip(changes, share, strict=False)
    ]
    sure = tuple(change for change in changes if change.confidence >= SURE_OF_NAME)
    explained = share[0] if share and not sure else 1.0
    is_open = first is not None and not sure and explained >= LEAST_PROBABILITY
    candidates = tuple(first.candidates) if first is not None and is_open else ()
    after = rows.residual_rms(new, background.mean + _amplitudes(rows, sure))
    unlike = prepared.unlike(level, before)
    return Comparison(
        score, threshold, sure, candidates, explained, score > threshold or bool(unlike.any()),
        background, null, before, after, prepared.usual, prepared.uncertainty, unlike,
    )  # fmt: skip


def _gain(rows: Rows, columns: NDArray[np.intp], before: FloatArray, after: FloatArray) -> float:
    """Share of the squared residual that a change removes, joints on which it acts alike."""
    acts = [bool(np.isin(columns, sums.columns).any()) for sums in rows.sums[0]]
    seen = np.array(acts) & (before > 0.0)
    return 1.0 - float(np.mean((after[seen] / before[seen]) ** 2)) if seen.any() else 0.0
