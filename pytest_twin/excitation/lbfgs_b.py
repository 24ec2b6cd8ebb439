"""Minimize with scipy's L-BFGS-B."""

from __future__ import annotations

import numpy as np
import scipy.optimize

from pytest_twin.arrays import FloatArray
from pytest_twin.excitation.minimizers import Objective


def lbfgs_b(
    objective: Objective, first: FloatArray, iterations: int, tolerance: float
) -> FloatArray:
    """Return the (n,) minimum; see :class:`~pytest_twin.excitation.minimizers.Minimizer`."""
    solved = scipy.optimize.minimize(
        objective,
        first,
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": iterations, "ftol": tolerance},
    )
    return np.asarray(solved.x)
