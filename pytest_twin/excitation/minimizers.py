"""Solvers for the D-optimal series.

A solver is imported when it is used, so that the command can list them without an import.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import SpecError

SOLVERS = ("scipy", "ipopt")
Objective = Callable[[FloatArray], tuple[float, FloatArray]]
"""Function of a free vector (n,) that returns value and gradient (n,)."""


class Minimizer(Protocol):
    """Minimizes an objective without bounds and constraints."""

    def __call__(
        self, objective: Objective, first: FloatArray, iterations: int, tolerance: float
    ) -> FloatArray:
        """Return the (n,) minimum.

        Args:
            objective: function that returns value and gradient.
            first: (n,) start.
            iterations: largest number of iterations.
            tolerance: relative change of the objective at which the solver stops.
        """


def minimizer(solver: str) -> Minimizer:
    """Return the solver with a name of :data:`SOLVERS`.

    Raises:
        SpecError: casadi, which contains IPOPT, is not installed.
    """
    if solver == "scipy":
        from pytest_twin.excitation.lbfgs_b import lbfgs_b

        return lbfgs_b
    try:
        from pytest_twin.excitation.ipopt import ipopt
    except ImportError:
        raise SpecError(
            "casadi, which contains IPOPT, is not installed",
            where="--solver",
            value=solver,
            expected="pip install 'pytest-twin[ipopt]', or --solver scipy",
        ) from None
    return ipopt
