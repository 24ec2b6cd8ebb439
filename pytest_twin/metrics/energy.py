"""Energy balance of a simulated mechanical system."""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray


def energy_growth(
    energy: FloatArray, actuator_work: FloatArray, constraint_work: FloatArray
) -> float:
    """Energy that the simulation created without a physical source, J, not negative.

    The result is the larger of two violations:

    - Energy minus the work done on the system can only decrease, by damping. The violation is its
      largest rise above an earlier value. Servos, contacts and limits are included in the work.
    - Contacts, limits and friction store no energy at the start, so that their total work cannot be
      positive. The violation is its largest value, for example of bodies that start in penetration.

    Args:
        energy: (n,) kinetic and potential energy with springs, J.
        actuator_work, constraint_work: (n,) work done on the system since the first sample, J.
    """
    passive = energy - actuator_work - constraint_work
    rise = float(np.max(passive - np.minimum.accumulate(passive)))
    return max(rise, float(np.max(constraint_work)), 0.0)
