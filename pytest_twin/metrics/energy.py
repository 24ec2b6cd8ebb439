"""Mechanical energy of a system that nothing should feed."""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray


def energy_growth(
    energy: FloatArray, actuator_work: FloatArray, constraint_work: FloatArray
) -> float:
    """Energy that came from nowhere, in J, 0 or more.

    Two balances, the larger of which counts:

    - Energy less all work done on the system can only fall, by damping: its largest rise above an
      earlier value. Servos give and take through their work, contacts and limits likewise.
    - Contacts, limits and friction start without stored energy, so the work that they have done
      in all can never be positive: its largest value. Bodies that start inside each other show.

    Args:
        energy: (n,) J, kinetic, potential and in springs.
        actuator_work, constraint_work: (n,) J done on the system since the first sample.
    """
    passive = energy - actuator_work - constraint_work
    rise = float(np.max(passive - np.minimum.accumulate(passive)))
    return max(rise, float(np.max(constraint_work)), 0.0)
