"""Joint distribution of uncertain parameters, as correlated coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.special import ndtr, ndtri

from pytest_twin.arrays import FloatArray

_NEVER_BEYOND = 8.0
"""Distance of the mean from a bound, in standard deviations, above which a double-precision draw
never reaches it."""
_LARGEST = 1.0 - 2.0**-53
"""Largest probability below 1 in double precision."""


@dataclass(frozen=True, slots=True)
class Source:
    """One source of a coordinate's variance.

    Attributes:
        kind: ``covariance``, ``trials``, ``tolerance``, or ``widening``.
        name: name of the record, or place of the declaration.
        std: standard deviation that it adds; for ``widening``, the standard deviation before it
            times ``factor``.
        factor: factor on the standard deviation; 1 for all other kinds.
    """

    kind: Literal["covariance", "trials", "tolerance", "widening"]
    name: str
    std: float
    factor: float = 1.0

    def to_json(self) -> dict[str, Any]:
        """JSON-able fields."""
        found: dict[str, Any] = {"kind": self.kind, "name": self.name, "std": self.std}
        return found if self.kind != "widening" else {**found, "factor": self.factor}


@dataclass(frozen=True, slots=True)
class UpperLimit:
    """Largest value of a coordinate that depends on another one: ``factor other + rest``.

    Back-EMF is a part of its joint's damping, so the damping of a robot is its largest back-EMF.

    Attributes:
        name: name of the other coordinate.
        rest: in the coordinate's unit.
    """

    name: str
    factor: float = 1.0
    rest: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """JSON-able fields."""
        return {"name": self.name, "factor": self.factor, "rest": self.rest}


@dataclass(frozen=True, slots=True)
class Coordinate:
    """One random parameter, which differs between robots or episodes.

    Attributes:
        name: such as ``elbow.viscous_friction``.
        unit: SI unit.
        mean, std: of the normal distribution before it is truncated at ``lower`` and ``upper``.
        lower, upper: values that no robot exceeds; infinite for none.
        joint: joint whose motion it affects directly, or None.
        body, index: for a body's inertia: name of the body, and index of the coordinate.
        effect, parameter: for a catalogued effect: name of the effect and of its parameter.
        is_relative: whether the value is a factor, 1 plus the effect's relative parameter.
        is_deviation: whether the value is added to the one that the twin has.
        field: for a joint of the model: ``damping``, ``frictionloss`` or ``armature``.
        is_condition: whether it is a condition of the trials, such as their temperature, without
            direct effect on the motion.
        at_most: limit by another coordinate of the same robot, or None.
    """

    name: str
    unit: str
    mean: float
    std: float
    lower: float = -np.inf
    upper: float = np.inf
    joint: str | None = None
    body: str | None = None
    index: int = 0
    effect: str | None = None
    parameter: str | None = None
    is_relative: bool = False
    is_deviation: bool = False
    field: str | None = None
    is_condition: bool = False
    at_most: UpperLimit | None = None
    sources: tuple[Source, ...] = ()

    @property
    def law(self) -> str:
        """Name of the distribution."""
        if not (np.isfinite(self.lower) or np.isfinite(self.upper)):
            return "normal"
        at_zero = self.lower == 0.0 and not np.isfinite(self.upper)
        return "normal cut off at zero" if at_zero else "normal cut off at bounds"

    def values(self, normal: FloatArray) -> FloatArray:
        """Map standard normal values to values of the normal or truncated normal distribution.

        The quantile function of the truncated normal distribution (Johnson, Kotz, Balakrishnan,
        Continuous Univariate Distributions 1, 1994, sec. 13.10.1) preserves the order and thus the
        rank correlation.
        """
        if self.std == 0.0:
            return np.full(normal.shape, self.mean)
        low, high = (self.lower - self.mean) / self.std, (self.upper - self.mean) / self.std
        if low < -_NEVER_BEYOND and high > _NEVER_BEYOND:
            return np.asarray(self.mean + self.std * normal)
        # The probability of larger values keeps its precision where most of the normal
        # distribution is below the bounds. Where most of it is above, both signs are changed.
        side = -1.0 if high < 0.0 else 1.0
        if side < 0.0:
            low, high = -high, -low
        above = ndtr(-high) + ndtr(-side * normal) * (ndtr(-low) - ndtr(-high))
        cut = self.mean - side * self.std * ndtri(np.clip(above, 1e-300, _LARGEST))
        least = np.finfo(float).tiny if self.lower == 0.0 else self.lower
        return np.asarray(np.clip(cut, least, self.upper))

    def interval(self, share: float) -> tuple[float, float]:
        """Return the central interval that contains this fraction of the values."""
        ends = ndtri(np.array([0.5 - 0.5 * share, 0.5 + 0.5 * share]))
        low, high = self.values(ends)
        return float(low), float(high)


@dataclass(frozen=True)
class Distribution:
    """Coordinates with their joint distribution (a Gaussian copula).

    Attributes:
        coordinates: (p,).
        correlation: (p, p) correlation of the underlying normal variables.
    """

    coordinates: tuple[Coordinate, ...]
    correlation: FloatArray

    def __len__(self) -> int:
        return len(self.coordinates)

    @property
    def std(self) -> FloatArray:
        """(p,) standard deviations."""
        return np.array([one.std for one in self.coordinates])

    @property
    def covariance(self) -> FloatArray:
        """(p, p)."""
        return np.asarray(self.correlation * np.outer(self.std, self.std))

    @property
    def root(self) -> FloatArray:
        """(p, k) ``L`` with ``L L^T`` the correlation, where k is its rank."""
        values, vectors = np.linalg.eigh(self.correlation)
        use = values > 1e-12 * max(float(values.max(initial=0.0)), 1.0)
        return np.asarray(vectors[:, use] * np.sqrt(values[use]))

    def normals(self, count: int, seed: int) -> FloatArray:
        """(count, p) correlated standard normal variables."""
        root = self.root
        free = np.random.default_rng(seed).standard_normal((count, root.shape[1]))
        return np.asarray(free @ root.T)

    def draws(self, count: int, seed: int) -> FloatArray:
        """(count, p) values of the coordinates."""
        return self.values(self.normals(count, seed))

    def values(self, normals: FloatArray) -> FloatArray:
        """(count, p) values of the coordinates at (count, p) standard normal variables."""
        columns = [one.values(normals[:, k]) for k, one in enumerate(self.coordinates)]
        at = {one.name: k for k, one in enumerate(self.coordinates)}
        for k, one in enumerate(self.coordinates):
            if one.at_most is not None:
                limit = one.at_most.factor * columns[at[one.at_most.name]] + one.at_most.rest
                columns[k] = np.minimum(columns[k], limit)
        return np.stack(columns, axis=1) if columns else np.zeros((len(normals), 0))

    def widened(self, factors: Sequence[float], why: str) -> Distribution:
        """Return the distribution with standard deviations times (p,) factors."""
        widened = tuple(
            one
            if factor == 1.0
            else replace(
                one,
                std=one.std * factor,
                sources=(*one.sources, Source("widening", why, one.std * factor, factor)),
            )
            for one, factor in zip(self.coordinates, factors, strict=True)
        )
        return replace(self, coordinates=widened)


def distribution_of(
    coordinates: Sequence[Coordinate], covariance: FloatArray, *, floor: float = 0.0
) -> Distribution:
    """Build a distribution from coordinates and their covariance.

    Coordinates that do not vary are left out.

    Args:
        coordinates: (p,) with any standard deviation.
        covariance: (p, p) covariance, positive semidefinite.
        floor: standard deviation below which a coordinate is constant, as a fraction of the largest
            one with the same unit.
    """
    std = np.sqrt(np.diag(covariance).clip(0.0))
    largest: dict[str, float] = {}
    for one, own in zip(coordinates, std, strict=True):
        largest[one.unit] = max(largest.get(one.unit, 0.0), float(own))
    kept = np.array(
        [k for k, one in enumerate(coordinates) if std[k] > floor * largest[one.unit]],
        dtype=np.intp,
    )
    scale = std[kept]
    correlation = covariance[np.ix_(kept, kept)] / np.outer(scale, scale)
    chosen = tuple(replace(coordinates[k], std=float(std[k])) for k in kept)
    return Distribution(chosen, np.asarray(correlation, dtype=np.float64))
