"""The joint distribution of what is uncertain: correlated coordinates, each with its own law."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.special import ndtr, ndtri

from pytest_twin.arrays import FloatArray

Support = Literal["any", "positive"]
_NEVER_NEGATIVE = 8.0
"""Standard deviations from zero from which on no double is ever drawn below it."""
_LARGEST = 1.0 - 2.0**-53


@dataclass(frozen=True, slots=True)
class Source:
    """One reason why a coordinate varies.

    Attributes:
        kind: ``covariance``, ``trials``, ``tolerance``, or ``widening``.
        name: the record, or where it is declared.
        std: standard deviation that it adds; of ``widening`` that of everything before it, times
            ``factor``.
        factor: by which the standard deviation grows; 1 of all other kinds.
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
class Coordinate:
    """One number that differs from robot to robot, or from episode to episode.

    Attributes:
        name: such as ``elbow.viscous_friction``.
        unit: SI.
        mean, std: of a normal variable; where it has to be ``positive``, cut off at zero.
        support: which values it can have.
        joint: whose motion it moves first, or None.
        body, index: of a body's inertia: which body, and which of its ten coordinates.
        effect, parameter: of a catalogued effect: which, and which of its parameters.
        relative: whether the value is a factor, 1 more than the effect's relative parameter.
        field: of a model's joint: ``damping``, ``frictionloss`` or ``armature``.
        condition: whether it is a condition of the trials, such as their temperature, that moves
            nothing by itself.
        sources: why it varies.
    """

    name: str
    unit: str
    mean: float
    std: float
    support: Support = "any"
    joint: str | None = None
    body: str | None = None
    index: int = 0
    effect: str | None = None
    parameter: str | None = None
    relative: bool = False
    field: str | None = None
    condition: bool = False
    sources: tuple[Source, ...] = ()

    def values(self, normal: FloatArray) -> FloatArray:
        """Values at standard normal ones: of the normal law, or of the one cut off at zero.

        The quantile function of the truncated normal (Johnson, Kotz, Balakrishnan, Continuous
        Univariate Distributions 1, 1994, sec. 13.10.1) keeps the order, and with it the rank
        correlation.
        """
        if self.std == 0.0:
            return np.full(normal.shape, self.mean)
        ratio = self.mean / self.std
        if self.support == "any" or ratio > _NEVER_NEGATIVE:
            return np.asarray(self.mean + self.std * normal)
        # By the upper tail: nothing is lost where most of the normal lies below zero.
        above = ndtr(-normal) * ndtr(ratio)
        cut = np.asarray(self.mean - self.std * ndtri(np.clip(above, 1e-300, _LARGEST)))
        return np.maximum(cut, np.finfo(float).tiny)

    def interval(self, share: float) -> tuple[float, float]:
        """The central interval that holds this share of the values."""
        ends = ndtri(np.array([0.5 - 0.5 * share, 0.5 + 0.5 * share]))
        low, high = self.values(ends)
        return float(low), float(high)


@dataclass(frozen=True)
class Distribution:
    """Coordinates and how they vary together (a Gaussian copula).

    Attributes:
        coordinates: (p,).
        correlation: (p, p) of the normal variables behind them.
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
        """(p, k) ``L`` with ``L L^T`` the correlation; only as many columns as it has rank."""
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
        return np.stack(columns, axis=1) if columns else np.zeros((len(normals), 0))

    def widened(self, factors: Sequence[float], why: str) -> Distribution:
        """The same with standard deviations times (p,) factors, which the sources then hold."""
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

    def without_variation(self) -> Distribution:
        """The same at the means."""
        still = tuple(replace(one, std=0.0) for one in self.coordinates)
        return replace(self, coordinates=still)


def distribution_of(
    coordinates: Sequence[Coordinate], covariance: FloatArray, *, floor: float = 0.0
) -> Distribution:
    """A distribution whose standard deviations are those of a covariance.

    Coordinates that do not vary are left out.

    Args:
        coordinates: (p,) with any standard deviation.
        covariance: (p, p), positive semidefinite.
        floor: standard deviation up to which a coordinate counts as constant, a share of the
            largest of its kind (same unit).
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
