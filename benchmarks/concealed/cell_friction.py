"""Compiled laws of dynamic friction; each computes one step of the integrator.

LuGre: Canudas de Wit et al. 1995. Dahl 1968. Generalized Maxwell slip: Al-Bender, Lampaert, Swevers
2005. The fourth law, set-valued Coulomb friction, has no memory: :mod:`cell_kernel` solves it
together with the accelerations.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

LAWS = ("lugre", "dahl", "maxwell_slip", "set_valued")
ELEMENTS = 4
SHARES = np.array([0.15, 0.25, 0.35, 0.25])
"""Fraction of the friction level of each element of generalized Maxwell slip."""
YIELDS = np.array([0.3, 0.8, 1.5, 3.0])
"""Displacement at which each element slips, in multiples of the joint's presliding displacement."""
ATTRACTION = 0.02
"""Time constant with which a slipping element approaches its friction level, s."""


@njit(cache=True, error_model="numpy")
def friction_effort(
    law: int, level: float, stretch: float, inertia: float, v: float, step: float, z: Any, slip: Any
) -> float:
    """Friction torque, N*m, opposite to ``v``; ``z`` and ``slip`` (ELEMENTS,) are its state.

    Args:
        level: friction of steady sliding at this velocity, with the Stribeck effect, N*m.
        stretch: displacement at which the bristles yield, rad.
        inertia: inertia that determines the damping of LuGre's bristles, kg*m^2.
    """
    if law == 2:
        total = 0.0
        for e in range(ELEMENTS):
            share = SHARES[e] * level
            if slip[e] != 0.0 and slip[e] * v <= 0.0:
                slip[e] = 0.0
            if slip[e] == 0.0:
                z[e] += step * v * share / (YIELDS[e] * stretch)
                if abs(z[e]) >= share:
                    slip[e] = np.sign(z[e])
                    z[e] = slip[e] * share
            else:
                z[e] += step / ATTRACTION * (slip[e] * share - z[e])
            total += z[e]
        return total
    rate = v - abs(v) * z[0] / stretch
    z[0] = min(max(z[0] + step * rate, -stretch), stretch)
    total = level * z[0] / stretch
    if law == 0:
        total += 0.7 * np.sqrt(level / stretch * inertia) * rate
    return total
