"""Ranges in the quantities that people and simulators use: masses, centres, friction, delays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.ranges.bodies import Body, principal
from pytest_twin.ranges.distribution import Distribution

_DRAWS = 4096
"""Of which ranges of inertias are quantiles: an end of a 95 % range is then known to a tenth of a
standard deviation."""
_SEED = 59
_ROUNDING = 1e-9
_SMALL = {"kg": 1e-6, "m": 1e-3, "kg*m^2": 1e-9}
"""What is no size for a robot's body: variation below ``_ROUNDING`` of it is that of digits."""


def quantities(
    distribution: Distribution,
    bodies: Sequence[Body],
    share: float,
    noise: Mapping[str, float],
) -> list[dict[str, Any]]:
    """Name, unit, middle and central range of each quantity; a range holds a share of the robots.

    Args:
        distribution: of the coordinates.
        bodies: whose inertia varies.
        share: that a range holds.
        noise: joint -> standard deviation of a reading, rad or m.
    """
    found = []
    for one in distribution.coordinates:
        if one.body is None:
            varies = "with the trial" if one.condition else "per episode"
            ends = one.interval(share)
            found.append(_quantity(one.name, one.unit, one.mean, *ends, one.std, one.joint, varies))
    draws = distribution.draws(_DRAWS, _SEED)
    for body in bodies:
        for name, unit, values, nominal in _of_body(body, distribution, draws):
            if values.std() <= _ROUNDING * (np.abs(values).max() + _SMALL[unit]):
                continue
            low, high = np.quantile(values, (0.5 - 0.5 * share, 0.5 + 0.5 * share))
            found.append(
                _quantity(name, unit, nominal, float(low), float(high), float(values.std()),
                          body.joint, "per episode", body.name)
            )  # fmt: skip
    return found


def body_coordinates(body: Body, distribution: Distribution, draws: FloatArray) -> FloatArray:
    """(n, 10) log-Cholesky coordinates of a body in (n, p) draws."""
    x = np.zeros((len(draws), 10))
    for column, one in enumerate(distribution.coordinates):
        if one.body == body.name:
            x[:, one.index] = draws[:, column]
    return x


def _of_body(
    body: Body, distribution: Distribution, draws: FloatArray
) -> list[tuple[str, str, FloatArray, float]]:
    """Name, unit, drawn values and the value of the model: mass, centre, largest moment."""
    x = np.concatenate([np.zeros((1, 10)), body_coordinates(body, distribution, draws)])
    mass, com, second = body.rigid(x)
    moments, _ = principal(second)
    columns = [("mass", "kg", mass)]
    columns += [(f"com_{axis}", "m", com[:, k]) for k, axis in enumerate("xyz")]
    columns += [(f"inertia_{k + 1}", "kg*m^2", moments[:, k]) for k in range(3)]
    return [(f"{body.name}.{name}", unit, v[1:], float(v[0])) for name, unit, v in columns]


def _quantity(
    name: str,
    unit: str,
    nominal: float,
    low: float,
    high: float,
    std: float,
    joint: str | None,
    varies: str,
    body: str | None = None,
) -> dict[str, Any]:
    return {"name": name, "unit": unit, "nominal": nominal, "range": [low, high], "std": std,
            "joint": joint, "body": body, "varies": varies}  # fmt: skip
