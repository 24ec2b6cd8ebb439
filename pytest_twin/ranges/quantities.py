"""Ranges of physical quantities: masses, centres of mass, inertias, friction, delays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.ranges.bodies import Body, principal
from pytest_twin.ranges.distribution import Distribution

_DRAWS = 4096
"""Number of draws for the quantiles of ranges. The ends of a 95 % range are then accurate to a
tenth of a standard deviation."""
_SEED = 59
"""Seed of the draws, so that ranges can be repeated."""
_ROUNDING = 1e-9
"""Relative standard deviation below which a quantity is constant."""
_SMALL = {"kg": 1e-6, "m": 1e-3, "kg*m^2": 1e-9}
"""Smallest size of a robot's body by unit. Variation below ``_ROUNDING`` times this size is
rounding."""


@dataclass(frozen=True)
class Quantity:
    """One physical quantity of a robot with its variation.

    Attributes:
        name: such as ``elbow.coulomb_friction`` or ``fore.mass``.
        unit: SI unit.
        nominal: value in the twin.
        range: central range that contains the stated fraction of the robots.
        draws: (n,) random values.
        joint: joint whose motion it affects directly, or None.
        body: body that it belongs to, or None.
        is_condition: whether it is a condition of the trials.
    """

    name: str
    unit: str
    nominal: float
    range: tuple[float, float]
    draws: FloatArray
    joint: str | None
    body: str | None = None
    is_condition: bool = False

    @property
    def owner(self) -> str:
        """Name of the body or joint, the part before the last dot."""
        return self.name.rpartition(".")[0]

    @property
    def kind(self) -> str:
        """Kind of the quantity, such as ``coulomb_friction``."""
        return self.name.rpartition(".")[2]

    def to_json(self) -> dict[str, Any]:
        """JSON-able fields."""
        return {
            "name": self.name,
            "unit": self.unit,
            "nominal": self.nominal,
            "range": list(self.range),
            "std": float(self.draws.std()),
            "joint": self.joint,
            "body": self.body,
            "varies": "with the trial" if self.is_condition else "per episode",
        }


def quantities(distribution: Distribution, bodies: Sequence[Body], share: float) -> list[Quantity]:
    """Return every quantity that varies.

    Args:
        distribution: distribution of the coordinates.
        share: fraction of the robots that a range contains.
    """
    draws = distribution.draws(_DRAWS, _SEED)
    tails = 0.5 - 0.5 * share, 0.5 + 0.5 * share
    found = []
    for column, one in enumerate(distribution.coordinates):
        if one.body is None:
            low, high = one.interval(share)
            if one.at_most is not None:
                low, high = np.quantile(draws[:, column], tails).tolist()
            found.append(
                Quantity(one.name, one.unit, one.mean, (low, high), draws[:, column], one.joint,
                         is_condition=one.is_condition)
            )  # fmt: skip
    for body in bodies:
        for name, unit, values, nominal in _of_body(body, distribution, draws):
            if values.std() > _ROUNDING * (np.abs(values).max() + _SMALL[unit]):
                low, high = np.quantile(values, tails).tolist()
                found.append(
                    Quantity(name, unit, nominal, (low, high), values, body.joint, body.name)
                )
    return found


def _of_body(
    body: Body, distribution: Distribution, draws: FloatArray
) -> list[tuple[str, str, FloatArray, float]]:
    """Return name, unit, draws and nominal value of mass, centre of mass and moments of inertia."""
    x = np.zeros((len(draws) + 1, 10))
    for column, one in enumerate(distribution.coordinates):
        if one.body == body.name:
            x[1:, one.index] = draws[:, column]
    mass, com, second = body.rigid(x)
    moments, _ = principal(second)
    columns = [("mass", "kg", mass)]
    columns += [(f"com_{axis}", "m", com[:, k]) for k, axis in enumerate("xyz")]
    columns += [(f"inertia_{k + 1}", "kg*m^2", moments[:, k]) for k in range(3)]
    return [(f"{body.name}.{name}", unit, v[1:], float(v[0])) for name, unit, v in columns]
