"""Coefficient of restitution of a spring-damper contact."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pytest_twin.identification.contact.fit import ContactFit
from pytest_twin.identification.contact.parameters import DAMPING, STIFFNESS

_DRAWS = 2000
"""Number of draws for the interval of the restitution."""


def restitution(stiffness: float, damping: float) -> float:
    """Return the coefficient of restitution of a point mass without gravity.

    The contact force is never attractive. The contact ends when the force reaches zero, while the
    spring is still compressed (Schwager, Pöschel, Granular Matter 9, 2007, eqs. 18 to 21).

    Args:
        stiffness: 1/s^2.
        damping: 1/s.
    """
    half, own = 0.5 * damping, float(np.sqrt(stiffness))
    if half < own:
        wave = float(np.sqrt(stiffness - half**2))
        lag = float(np.arctan2(2.0 * half * wave, wave**2 - half**2))
        return float(np.exp(-half / wave * (np.pi - lag)))
    wave = float(np.sqrt(max(half**2 - stiffness, 1e-12 * stiffness)))
    return float(np.exp(-half / wave * np.log((half + wave) / (half - wave))))


def restitution_of(fit: ContactFit) -> Mapping[str, Any] | None:
    """Return restitution with its 95 % interval; None if stiffness or damping is undetermined."""
    if not {STIFFNESS, DAMPING} <= set(fit.names):
        return None
    at = [fit.names.index(name) for name in (STIFFNESS, DAMPING)]
    values = np.array([fit.values[STIFFNESS], fit.values[DAMPING]])
    # Both are estimated as logarithms.
    spread = fit.covariance[np.ix_(at, at)] / np.outer(values, values)
    steps = np.random.default_rng(8).multivariate_normal(np.zeros(2), spread, _DRAWS)
    drawn = values * np.exp(steps)
    found = [restitution(*row) for row in drawn.tolist()]
    low, high = np.quantile(found, [0.025, 0.975]).tolist()
    return {"value": restitution(*values.tolist()), "unit": "1", "ci95": [low, high]}
