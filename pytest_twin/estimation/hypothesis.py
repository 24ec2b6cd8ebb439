"""A hypothesis: a set of effects, the joint of each, and their parameters."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue
from pytest_twin.effects.active_effects import EffectValues
from pytest_twin.effects.base import SMOOTH_STEP, Effect, Parameter
from pytest_twin.effects.proposal import amplitude_indices, is_estimated


@dataclass(frozen=True, slots=True, order=True)
class Term:
    """One effect at one joint.

    Attributes:
        joint: column of the joint; -1 for an effect of the whole robot.
    """

    effect: str
    joint: int

    @property
    def law(self) -> Effect:
        """The effect's class in the catalogue."""
        return catalogue()[self.effect]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of the effect."""
        return self.law.parameters

    def is_estimated(self, theta: FloatArray) -> NDArray[np.bool_]:
        """(parameters,) whether a fit estimates each of them.

        Discrete choices are not estimated, nor parameters that the chosen form lacks.
        """
        return is_estimated(self.law, theta)

    @property
    def dry_level(self) -> int | None:
        """Index of the parameter that is a constant level of dry friction; None without one."""
        name = self.law.dry_friction_level
        return next((k for k, p in enumerate(self.parameters) if p.name == name), None)

    def amplitude_indices(self, theta: FloatArray) -> tuple[int, ...]:
        """Indices of the amplitudes of the effect, in the form that ``theta`` selects."""
        return amplitude_indices(self.law, theta)


@dataclass(frozen=True, slots=True)
class Scales:
    """Reference scales of the parameters: reference name -> (joints,) values, SI units."""

    of: Mapping[str, FloatArray]

    def value(self, parameter: Parameter, joint: int) -> float:
        """Reference scale of a parameter at a joint, SI units.

        An effect of the whole robot (-1) uses the scale of the first joint.
        """
        return float(self.of[parameter.reference][max(joint, 0)])


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A set of terms with one parameter vector.

    Attributes:
        theta: (parameters,) parameters of all terms in order, in multiples of their scales.
    """

    terms: tuple[Term, ...]
    theta: FloatArray

    def with_theta(self, theta: FloatArray) -> Hypothesis:
        """The same terms with other parameters."""
        return Hypothesis(self.terms, theta)

    def with_term(self, term: Term, start: FloatArray) -> Hypothesis:
        """The hypothesis with one more term; ``start`` holds its parameters."""
        return Hypothesis((*self.terms, term), np.concatenate([self.theta, start]))

    def with_term_of(self, other: Hypothesis, term: Term) -> Hypothesis:
        """The hypothesis with one more term and its parameters, both taken from ``other``."""
        return self.with_term(term, other.theta[other.slice_of(term)])

    def with_terms(self, starts: Mapping[Term, FloatArray]) -> Hypothesis:
        """The hypothesis with several more terms, each with its parameters."""
        added = self
        for term, start in starts.items():
            added = added.with_term(term, start)
        return added

    def more_terms(self, than: Hypothesis) -> int:
        """Number of terms minus the number of terms of ``than``."""
        return len(self.terms) - len(than.terms)

    def without(self, *removed: Term) -> Hypothesis:
        """The hypothesis without these terms."""
        kept = tuple(t for t in self.terms if t not in removed)
        return Hypothesis(kept, self.theta[self.parameters_without(*removed)])

    def parameters_without(self, *removed: Term) -> NDArray[np.bool_]:
        """(parameters,) whether each parameter belongs to a term that is not in ``removed``."""
        return np.array([t not in removed for t in self.terms for _ in t.parameters], dtype=bool)

    def with_absorbed(self, removed: Term, into: Term) -> Hypothesis | None:
        """The hypothesis without ``removed``, whose effect ``into`` represents in addition.

        Parameters of ``into`` are clipped to their bounds. None if its law cannot represent the
        other effect.
        """
        own = self._parameters_by_name(into)
        changed = into.law.with_other(own, removed.effect, self._parameters_by_name(removed))
        if not changed:
            return None
        theta = self.theta.copy()
        theta[self.slice_of(into)] = [changed.get(name, value) for name, value in own.items()]
        return self.with_theta(np.clip(theta, *self.bounds)).without(removed)

    def _parameters_by_name(self, term: Term) -> dict[str, float]:
        """Parameters of a term by name, in multiples of their scales."""
        values = self.theta[self.slice_of(term)].tolist()
        return dict(zip((p.name for p in term.parameters), values, strict=True))

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds, (parameters,) each, in multiples of the scales."""
        parameters = [p for t in self.terms for p in t.parameters]
        return np.array([p.lower for p in parameters]), np.array([p.upper for p in parameters])

    def is_at_bound(self, term: Term) -> bool:
        """Whether a parameter that switches the effect on is at its physical bound."""
        return any(
            p.neutral is not None and value != p.neutral and not p.lower < value < p.upper
            for p, value in zip(term.parameters, self.theta[self.slice_of(term)], strict=True)
        )

    def has_shape_at_bound(self, term: Term) -> bool:
        """Whether a shape parameter of the effect is at a physical bound.

        The law then probably compensates for another effect. Zero is accepted as a special case
        (rigid teeth, no damping). Start and end times may be at either end of the trial.
        """
        return any(
            p.neutral is None and not p.choice and p.reference != "twelfth"
            and value != 0.0 and not p.lower < value < p.upper
            for p, value in zip(term.parameters, self.theta[self.slice_of(term)], strict=True)
        )  # fmt: skip

    @property
    def free_count(self) -> int:
        """Number of parameters that a fit estimates."""
        return int(self.is_estimated.sum())

    @property
    def is_estimated(self) -> NDArray[np.bool_]:
        """(parameters,) whether a fit estimates each of them."""
        parts = zip(self.terms, self._parts(self.theta), strict=True)
        return np.concatenate([np.empty(0, dtype=bool), *(t.is_estimated(own) for t, own in parts)])

    @property
    def sizes(self) -> FloatArray:
        """(parameters,) absolute values, at least the smallest nonzero start of each parameter."""
        smallest_start = [
            min((abs(s) for s in p.starts if s != 0.0), default=1.0)
            for t in self.terms for p in t.parameters
        ]  # fmt: skip
        sizes: FloatArray = np.maximum(np.abs(self.theta), smallest_start)
        return sizes

    @property
    def is_discontinuous(self) -> bool:
        """Whether the motion is discontinuous in some parameter."""
        return any(p.step > SMOOTH_STEP for t in self.terms for p in t.parameters)

    @property
    def coordinates(self) -> FloatArray:
        """(parameters,) coordinates in which the laws are closer to linear; a fit steps in them."""
        parts = zip(self.terms, self._parts(self.theta), strict=True)
        return np.concatenate([np.empty(0), *(t.law.coordinates(own) for t, own in parts)])

    def from_coordinates(self, coordinates: FloatArray) -> FloatArray:
        """The inverse of :attr:`coordinates`, for the same terms."""
        parts = zip(self.terms, self._parts(coordinates), strict=True)
        return np.concatenate([np.empty(0), *(t.law.from_coordinates(own) for t, own in parts)])

    def _parts(self, values: FloatArray) -> list[FloatArray]:
        """(parameters,) values by term."""
        counts = [len(t.parameters) for t in self.terms]
        return [
            values[end - count : end]
            for end, count in zip(itertools.accumulate(counts), counts, strict=True)
        ]

    def slice_of(self, term: Term) -> slice:
        """Slice of a term's parameters in ``theta``.

        Raises:
            KeyError: the hypothesis lacks the term.
        """
        at = 0
        for t in self.terms:
            if t == term:
                return slice(at, at + len(t.parameters))
            at += len(t.parameters)
        raise KeyError(term)


EMPTY = Hypothesis((), np.empty(0))
"""Hypothesis without effects: the nominal model."""


def absent_values(parameter: Parameter, joints: int, scales: Scales) -> FloatArray:
    """(joints,) values of a parameter at joints where its effect is absent, SI units."""
    if parameter.neutral is not None:
        return np.full(joints, parameter.neutral)
    return np.array([parameter.absent_value * scales.value(parameter, j) for j in range(joints)])


def effect_values(rows: Sequence[Hypothesis], joints: int, scales: Scales) -> EffectValues:
    """Parameters of every row's hypothesis as arrays; neutral where a row lacks the effect.

    Args:
        rows: one hypothesis for each simulation.
        joints: number of joints.
        scales: reference scales of the parameters.

    Returns:
        Effect id -> parameter name -> (rows, joints), SI units.
    """
    effects = sorted({t.effect for h in rows for t in h.terms})
    values: dict[str, dict[str, FloatArray]] = {}
    for effect in effects:
        values[effect] = {}
        for p in catalogue()[effect].parameters:
            values[effect][p.name] = np.tile(absent_values(p, joints, scales), (len(rows), 1))
    for i, h in enumerate(rows):
        at = 0
        for t in h.terms:
            for p in t.parameters:
                column = slice(None) if t.joint < 0 else t.joint
                values[t.effect][p.name][i, column] = h.theta[at] * scales.value(p, t.joint)
                at += 1
    return values
