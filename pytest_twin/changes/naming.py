"""Name the law that changed: the most probable one that the catalogue admits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.changes.background import Contrast
from pytest_twin.changes.evidence import Tempering, estimate, evidence_of, gains_of
from pytest_twin.changes.joint_friction import JointFriction, joint_frictions
from pytest_twin.changes.motor_types import TypeLaw
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.identification.effort.law_columns import Shape

_LEAST_PROBABILITY = 0.01
"""Probability below which another law is not listed."""


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


def best_possible(
    contrast: Contrast,
    shapes: Sequence[Shape],
    types: Sequence[TypeLaw],
    tempering: Tempering,
    largest: FloatArray,
) -> list[Change]:
    """The most probable law whose amplitudes the catalogue admits, as of :func:`best_change`.

    Rows are linear in the amplitudes, so a law may fit with a size that it cannot have, such as an
    encoder offset of four turns.

    Args:
        largest: (columns,) largest possible change of each amplitude.
    """
    evidence = evidence_of(contrast, shapes, tempering)
    position = {id(shape): k for k, shape in enumerate(shapes)}
    while True:
        named = best_change(contrast, shapes, types, tempering, evidence)
        impossible = [
            position[id(change.shape)]
            for change in named
            if np.any(np.abs(change.value) > largest[change.shape.indices])
        ]
        if not impossible or not np.isfinite(evidence[impossible]).any():
            return named
        evidence = evidence.copy()
        evidence[impossible] = -np.inf


def best_change(
    contrast: Contrast,
    shapes: Sequence[Shape],
    types: Sequence[TypeLaw],
    tempering: Tempering,
    evidence: FloatArray,
) -> list[Change]:
    """The most probable law in its best shape: one change, or one for each joint of a motor type.

    Two frictions of one joint are two changes if both changed.

    The gain is not yet known.
    """
    of_types = [law.estimate(contrast, tempering.inflation) for law in types]
    pairs = joint_frictions(shapes)
    of_pairs = [estimate(contrast, pair.columns, tempering.inflation) for pair in pairs]
    every = np.concatenate([evidence, [one[0] for one in (*of_types, *of_pairs)]])
    terms = [
        *(shape.term for shape in shapes), *(law.term for law in types),
        *(pair.term for pair in pairs),
    ]  # fmt: skip
    probability = probabilities(terms, every, tempering)
    alone = dict(probability)
    for pair in {pair.term: pair for pair in pairs}.values():
        of_both = probability.pop(pair.term)
        for k in pair.members:
            probability[shapes[k].term] += of_both
    term = max(probability, key=lambda law: probability[law])
    with_term = [
        (pair, of_pair)
        for pair, of_pair in zip(pairs, of_pairs, strict=True)
        if term in [shapes[k].term for k in pair.members] and alone[pair.term] > alone[term]
    ]
    if with_term:
        pair, (_, value, covariance) = max(with_term, key=lambda each: each[1][0])
        if tempering.significant(value, covariance).all():
            return _of_pair(pair, shapes, value, covariance, probability)
    best = max(
        (k for k, candidate in enumerate(terms) if candidate == term), key=lambda k: float(every[k])
    )
    confidence = probability[term]
    if best >= len(shapes):
        law, (_, value, covariance) = types[best - len(shapes)], of_types[best - len(shapes)]
        gains, penalties = gains_of(contrast, shapes)
        shown = gains / tempering.inflation > penalties
        changed = [k for k in law.members if shown[k]]
        if len(changed) != 1:
            return _of_type(law, shapes, value, covariance, confidence, _rivals(probability, term))
        # Only one of its joints changed.
        best, replaced = changed[0], term
        term = shapes[best].term
        confidence += probability[term]
        del probability[replaced]
    _, value, covariance = estimate(contrast, shapes[best].indices, tempering.inflation)
    simpler = _simplest(shapes, best, tempering.significant(value, covariance), evidence)
    if simpler != best:
        best, replaced = simpler, term
        term = shapes[best].term
        if term != replaced:
            confidence += probability[term]
            del probability[replaced]
        _, value, covariance = estimate(contrast, shapes[best].indices, tempering.inflation)
    return [Change(shapes[best], value, covariance, confidence, _rivals(probability, term))]


def _of_pair(
    pair: JointFriction,
    shapes: Sequence[Shape],
    value: FloatArray,
    covariance: FloatArray,
    probability: Mapping[Term, float],
) -> list[Change]:
    """Two frictions of a joint, the likelier first."""
    terms = [shapes[k].term for k in pair.members]
    others = {term: p for term, p in probability.items() if term not in terms}
    both = [
        Change(
            shapes[k], value[[at]], covariance[[at]][:, [at]], probability[term],
            _rivals(others, term),
        )
        for at, (k, term) in enumerate(zip(pair.members, terms, strict=True))
    ]  # fmt: skip
    return sorted(both, key=lambda change: -change.confidence)


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
