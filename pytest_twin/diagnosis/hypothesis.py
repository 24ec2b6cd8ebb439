"""A hypothesis: which effects act where, and with what parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue
from pytest_twin.effects.active_effects import EffectValues
from pytest_twin.effects.base import SMOOTH_STEP, Effect, Parameter


@dataclass(frozen=True, slots=True, order=True)
class Term:
    """One effect at one place: a joint's column, or -1 where it is the whole robot's."""

    effect: str
    joint: int

    @property
    def law(self) -> Effect:
        """The effect itself."""
        return catalogue()[self.effect]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Of its law."""
        return self.law.parameters

    def movable(self, theta: FloatArray) -> NDArray[np.bool_]:
        """(parameters,) which of them a fit moves: no choices, and what the law has under these."""
        choices = np.array([p.choice for p in self.parameters])
        return np.asarray(self.law.has(theta) & ~choices)

    def lone(self, theta: FloatArray) -> int | None:
        """Number of the only parameter that a fit moves in this form, None where there are more."""
        (which,) = np.nonzero(self.movable(theta))
        return int(which[0]) if len(which) == 1 else None

    @property
    def dry_level(self) -> int | None:
        """Number of the parameter that is a level of dry friction, None without one."""
        name = self.law.dry_friction_level
        return next((k for k, p in enumerate(self.parameters) if p.name == name), None)

    def switches(self, theta: FloatArray) -> tuple[int, ...]:
        """Which of them switch the effect on, in the form that its choices have."""
        has = self.law.has(theta)
        return tuple(i for i, p in enumerate(self.parameters) if p.neutral is not None and has[i])


@dataclass(frozen=True, slots=True)
class Scales:
    """What a joint's parameters are multiples of: reference name -> (joints,) values, SI units."""

    of: Mapping[str, FloatArray]

    def value(self, parameter: Parameter, joint: int) -> float:
        """The unit step of a parameter at a joint; of the whole robot, the first joint's."""
        return float(self.of[parameter.reference][max(joint, 0)])


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Terms and one parameter vector, in multiples of each parameter's scale."""

    terms: tuple[Term, ...]
    theta: FloatArray

    def with_theta(self, theta: FloatArray) -> Hypothesis:
        """The same terms elsewhere."""
        return Hypothesis(self.terms, theta)

    def with_term(self, term: Term, start: FloatArray) -> Hypothesis:
        """One more term, starting at ``start``."""
        return Hypothesis((*self.terms, term), np.concatenate([self.theta, start]))

    def with_term_of(self, other: Hypothesis, term: Term) -> Hypothesis:
        """One more term, as another has it."""
        return self.with_term(term, other.theta[other.slice_of(term)])

    def with_terms(self, starts: Mapping[Term, FloatArray]) -> Hypothesis:
        """Several more terms, each at its start."""
        added = self
        for term, start in starts.items():
            added = added.with_term(term, start)
        return added

    def with_values_of(self, other: Hypothesis) -> Hypothesis:
        """The same terms, with another's values of those that both have."""
        theta = self.theta.copy()
        for t in self.terms:
            if t in other.terms:
                theta[self.slice_of(t)] = other.theta[other.slice_of(t)]
        return self.with_theta(theta)

    def more_terms(self, than: Hypothesis) -> int:
        """How many terms it has more than another."""
        return len(self.terms) - len(than.terms)

    def without(self, *gone: Term) -> Hypothesis:
        """These terms fewer."""
        kept = tuple(t for t in self.terms if t not in gone)
        return Hypothesis(kept, self.theta[self.parameters_without(*gone)])

    def parameters_without(self, *gone: Term) -> NDArray[np.bool_]:
        """(parameters,) which of them belong to other terms."""
        return np.array([t not in gone for t in self.terms for _ in t.parameters], dtype=bool)

    def absorbed(self, gone: Term, into: Term) -> Hypothesis | None:
        """Without ``gone``, where ``into`` does the same physics as well, as far as its bounds go;
        None where it cannot.
        """
        own = self._named(into)
        changed = into.law.with_other(own, gone.effect, self._named(gone))
        if not changed:
            return None
        theta = self.theta.copy()
        theta[self.slice_of(into)] = [changed.get(name, value) for name, value in own.items()]
        return self.with_theta(np.clip(theta, *self.bounds)).without(gone)

    def _named(self, term: Term) -> dict[str, float]:
        """Parameters of a term by name, in multiples of their scales."""
        values = self.theta[self.slice_of(term)].tolist()
        return dict(zip((p.name for p in term.parameters), values, strict=True))

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper, in multiples of the scales."""
        parameters = [p for t in self.terms for p in t.parameters]
        return np.array([p.lower for p in parameters]), np.array([p.upper for p in parameters])

    def at_bound(self, term: Term) -> bool:
        """Whether a parameter that switches the effect on stands at its physical bound."""
        return any(
            p.neutral is not None and value != p.neutral and not p.lower < value < p.upper
            for p, value in zip(term.parameters, self.theta[self.slice_of(term)], strict=True)
        )

    def out_of_shape(self, term: Term) -> bool:
        """Whether a parameter that shapes the effect stands at a physical bound: the law
        compensates for another effect.

        At zero it is a special case (rigid teeth, no damping), and an edge in time may lie at
        either end of the trial.
        """
        return any(
            p.neutral is None and not p.choice and p.reference != "twelfth"
            and value != 0.0 and not p.lower < value < p.upper
            for p, value in zip(term.parameters, self.theta[self.slice_of(term)], strict=True)
        )  # fmt: skip

    @property
    def free(self) -> int:
        """How many parameters a fit moves."""
        return int(self.movable.sum())

    @property
    def movable(self) -> NDArray[np.bool_]:
        """(parameters,) which of them a fit moves."""
        parts = [t.movable(self.theta[self.slice_of(t)]) for t in self.terms]
        return np.concatenate([np.empty(0, dtype=bool), *parts])

    @property
    def sizes(self) -> FloatArray:
        """(parameters,) what each is, or the least size that its law is asked at."""
        least = [
            min((abs(s) for s in p.starts if s != 0.0), default=1.0)
            for t in self.terms for p in t.parameters
        ]  # fmt: skip
        found: FloatArray = np.maximum(np.abs(self.theta), least)
        return found

    @property
    def is_rough(self) -> bool:
        """Whether the motion follows some parameter in leaps."""
        return any(p.step > SMOOTH_STEP for t in self.terms for p in t.parameters)

    @property
    def coordinates(self) -> FloatArray:
        """The parameters, as their laws would have a fit step in them."""
        parts = [t.law.coordinates(self.theta[self.slice_of(t)]) for t in self.terms]
        return np.concatenate([np.empty(0), *parts])

    def from_coordinates(self, coordinates: FloatArray) -> FloatArray:
        """The inverse of :attr:`coordinates`, for the same terms."""
        parts = [t.law.from_coordinates(coordinates[self.slice_of(t)]) for t in self.terms]
        return np.concatenate([np.empty(0), *parts])

    def slice_of(self, term: Term) -> slice:
        """Where a term's parameters stand in ``theta``."""
        at = 0
        for t in self.terms:
            if t == term:
                return slice(at, at + len(t.parameters))
            at += len(t.parameters)
        raise KeyError(term)


EMPTY = Hypothesis((), np.empty(0))


def effect_values(rows: Sequence[Hypothesis], joints: int, scales: Scales) -> EffectValues:
    """Parameters of every row's hypothesis as arrays; neutral where a row lacks the effect."""
    effects = sorted({t.effect for h in rows for t in h.terms})
    values: dict[str, dict[str, FloatArray]] = {}
    for effect in effects:
        values[effect] = {}
        for p in catalogue()[effect].parameters:
            if p.neutral is not None:
                array = np.full((len(rows), joints), p.neutral)
            else:
                array = np.empty((len(rows), joints))
                array[:] = [p.absent * scales.value(p, j) for j in range(joints)]
            values[effect][p.name] = array
    for i, h in enumerate(rows):
        at = 0
        for t in h.terms:
            for p in t.parameters:
                column = slice(None) if t.joint < 0 else t.joint
                values[t.effect][p.name][i, column] = h.theta[at] * scales.value(p, t.joint)
                at += 1
    return values
