"""Name the law that changed: the most probable one that the catalogue admits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pytest_twin.arrays import FloatArray
from pytest_twin.changes.background import Background, Contrast, Rows
from pytest_twin.changes.evidence import (
    TWO_SIDED,
    Estimate,
    Tempering,
    estimated,
    evidence_of,
    sizes,
)
from pytest_twin.changes.joint_friction import JointFriction, joint_frictions
from pytest_twin.changes.motor_types import TypeLaw
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.identification.effort.law_columns import Shape

LEAST_PROBABILITY = 0.01
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


@dataclass(frozen=True)
class Candidate:
    """An explanation of what changed: one law, two frictions of a joint, or a law of a motor type.

    Attributes:
        terms: its laws, at one joint; at -1 for the robot and below for a motor type.
        motor: the motor type; None for a law of one joint or of the robot.
        probability: among all explanations and no change, which exclude each other.
    """

    terms: tuple[Term, ...]
    motor: str | None
    probability: float


@dataclass(frozen=True)
class Naming:
    """What changed.

    Attributes:
        changes: the most probable law in its best shape: one change, or one for each joint of a
            motor type, or two frictions of a joint. Their gain is not yet known.
        candidates: every explanation, the most probable first.
    """

    changes: list[Change]
    candidates: list[Candidate]


def best_possible(
    contrast: Contrast,
    shapes: Sequence[Shape],
    types: Sequence[TypeLaw],
    tempering: Tempering,
    rows: Rows,
    background: Background,
) -> Naming:
    """The most probable law whose amplitudes the catalogue admits, and all others.

    Rows are linear in the amplitudes, so a law may fit with a size that it cannot have, such as an
    encoder offset of four turns.

    Args:
        rows: recordings, with the bounds of the amplitudes.
        background: the laws before the change.
    """
    evidence = evidence_of(contrast, shapes, tempering.inflation)
    position = {id(shape): k for k, shape in enumerate(shapes)}
    while True:
        explanations = _Explanations(
            contrast, shapes, types, joint_frictions(shapes), tempering, evidence, rows, background
        )
        named = explanations.named()
        impossible = [
            position[id(change.shape)]
            for change in named.changes
            if np.any(np.abs(change.value) > rows.largest[change.shape.indices])
        ]
        if not impossible or not np.isfinite(evidence[impossible]).any():
            return named
        evidence = evidence.copy()
        evidence[impossible] = -np.inf


@dataclass(frozen=True)
class _Explanations:
    """Explanations of a difference: each law in each shape, laws of motor types, two frictions.

    Attributes:
        evidence: (shapes,) log evidence of each shape against no change.
    """

    contrast: Contrast
    shapes: Sequence[Shape]
    types: Sequence[TypeLaw]
    pairs: Sequence[JointFriction]
    tempering: Tempering
    evidence: FloatArray
    rows: Rows
    background: Background

    def named(self) -> Naming:
        """The most probable law, and all explanations."""
        alone = self.probability()
        probability = self.shared_with_members(alone)
        term = max(probability, key=lambda law: probability[law])
        changes = (
            self.both_frictions(term, alone, probability)
            or self.whole_type(term, probability)
            or [self.one_law(term, probability)]
        )
        if len(changes) == 1:
            # A law with fewer amplitudes, or of one joint instead of its type, may be the name.
            alone = _renamed(alone, term, changes[0].shape.term)
        return Naming(changes, self.candidates(alone))

    def candidates(self, alone: Mapping[Term, float]) -> list[Candidate]:
        """Every explanation, the most probable first.

        Args:
            alone: law, law of a type or two frictions -> probability.
        """
        pairs = {p.term: tuple(self.shapes[k].term for k in p.members) for p in self.pairs}
        motors = {law.term: law.motor for law in self.types}
        return [
            Candidate(pairs.get(term, (term,)), motors.get(term), probability)
            for term, probability in sorted(alone.items(), key=lambda each: -each[1])
        ]

    def probability(self) -> dict[Term, float]:
        """Law, law of a type or two frictions -> probability among all of them and no change."""
        others = [*self._of_types, *self._of_pairs]
        terms = [
            *(shape.term for shape in self.shapes), *(law.term for law in self.types),
            *(pair.term for pair in self.pairs),
        ]  # fmt: skip
        evidence = np.concatenate([self.evidence, *(one.evidence for one in others)])
        return probabilities(terms, evidence, self.tempering)

    def shared_with_members(self, alone: Mapping[Term, float]) -> dict[Term, float]:
        """Probabilities in which each of two frictions has that of both together as well."""
        probability = dict(alone)
        for pair in {pair.term: pair for pair in self.pairs}.values():
            of_both = probability.pop(pair.term)
            for k in pair.members:
                probability[self.shapes[k].term] += of_both
        return probability

    def both_frictions(
        self, term: Term, alone: Mapping[Term, float], probability: Mapping[Term, float]
    ) -> list[Change]:
        """Two frictions of a joint if they are likelier than one of them; else nothing.

        Args:
            alone: probabilities without those of two frictions.
        """
        likelier = [
            (pair, estimate)
            for pair, estimate in zip(self.pairs, self._of_pairs, strict=True)
            if term in [self.shapes[k].term for k in pair.members]
            and alone[pair.term] > alone[term]
        ]
        if not likelier:
            return []
        pair, estimate = max(likelier, key=lambda each: float(each[1].evidence[0]))
        value, covariance = estimate.value[0], estimate.covariance[0]
        if not self.tempering.significant(value, covariance).all():
            return []
        return _of_pair(pair, self.shapes, value, covariance, probability)

    def whole_type(self, term: Term, probability: dict[Term, float]) -> list[Change]:
        """Changes of all joints of a motor type, or of the only one that changed; else nothing."""
        of_law = [k for k, law in enumerate(self.types) if law.term == term]
        if not of_law:
            return []
        best = max(of_law, key=lambda k: float(self._of_types[k].evidence[0]))
        law, estimate = self.types[best], self._of_types[best]
        members = [self.shapes[k] for k in law.members]
        of_members = evidence_of(self.contrast, members, self.tempering.inflation)
        if np.count_nonzero(of_members > 0.0) == 1:
            only = law.members[int(of_members.argmax())]
            return [self._change(only, _renamed(probability, term, self.shapes[only].term))]
        return _of_type(
            law, self.shapes, estimate.value[0], estimate.covariance[0], probability[term],
            _rivals(probability, term),
        )  # fmt: skip

    def one_law(self, term: Term, probability: dict[Term, float]) -> Change:
        """Change of one law in its best shape."""
        of_law = [k for k, shape in enumerate(self.shapes) if shape.term == term]
        return self._change(max(of_law, key=lambda k: float(self.evidence[k])), probability)

    def _change(self, shape: int, probability: dict[Term, float]) -> Change:
        """Change of a shape, or of a simpler one with all its significant, possible amplitudes."""
        value, covariance = self._amplitudes(shape)
        significant = self.tempering.significant(value, covariance)
        significant &= self._is_possible(shape, value, covariance)
        simpler = _simplest(self.shapes, shape, significant, self.evidence)
        if simpler != shape:
            terms = self.shapes[shape].term, self.shapes[simpler].term
            shape, probability = simpler, _renamed(probability, *terms)
            value, covariance = self._amplitudes(shape)
        term = self.shapes[shape].term
        return Change(
            self.shapes[shape], value, covariance, probability[term], _rivals(probability, term)
        )

    def _is_possible(
        self, shape: int, value: FloatArray, covariance: FloatArray
    ) -> NDArray[np.bool_]:
        """(k,) whether each amplitude may have its value now; some cannot be negative.

        Where geometry or a filter leave a part of a large change, a law with more amplitudes fits
        it with a value that no robot can have.
        """
        columns = self.shapes[shape].indices
        deviation = np.hypot(self.background.deviation(columns), np.sqrt(np.diag(covariance)))
        now = self.background.mean[columns] + value
        return ~self.rows.not_negative[columns] | (now + ndtri(TWO_SIDED) * deviation >= 0.0)

    def _amplitudes(self, shape: int) -> tuple[FloatArray, FloatArray]:
        columns = self.shapes[shape].indices
        estimate = self._estimated(columns, sizes(np.eye(len(columns))))
        return estimate.value[0], estimate.covariance[0]

    @cached_property
    def _of_types(self) -> list[Estimate]:
        return [self._estimated(law.columns, law.priors()) for law in self.types]

    @cached_property
    def _of_pairs(self) -> list[Estimate]:
        return [self._estimated(pair.columns, sizes(np.eye(2))) for pair in self.pairs]

    def _estimated(self, columns: NDArray[np.intp], priors: FloatArray) -> Estimate:
        return estimated(self.contrast, columns[None], priors, self.tempering.inflation)


def _renamed(probability: Mapping[Term, float], old: Term, new: Term) -> dict[Term, float]:
    """Probabilities in which a law has that of another one, which is gone."""
    if old == new:
        return dict(probability)
    others = {term: p for term, p in probability.items() if term != old}
    return {**others, new: probability[new] + probability[old]}


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
        if law != term and p >= LEAST_PROBABILITY
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
