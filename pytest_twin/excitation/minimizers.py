"""Solvers that the D-optimal series can be found by.

Each is imported when it is asked for: the command names them without loading one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import SpecError

SOLVERS = ("scipy", "ipopt")
Objective = Callable[[FloatArray], tuple[float, FloatArray]]
"""Value and gradient (n,) at a free vector (n,)."""


class Minimizer(Protocol):
    """Minimizes an objective whose vector has no bounds and no constraints."""

    def __call__(
        self, objective: Objective, first: FloatArray, iterations: int, tolerance: float
    ) -> FloatArray:
        """(n,) where the solver ends.

        Args:
            objective: value and gradient.
            first: (n,) where it begins.
            iterations: at most.
            tolerance: relative change of the objective at which it ends.
        """


def minimizer(solver: str) -> Minimizer:
    """One of :data:`SOLVERS`.

    Raises:
        SpecError: casadi, which IPOPT comes with, is not installed.
    """
    if solver == "scipy":
        from pytest_twin.excitation.lbfgs_b import lbfgs_b

        return lbfgs_b
    try:
        from pytest_twin.excitation.ipopt import ipopt
    except ImportError:
        raise SpecError(
            "IPOPT comes with casadi, which is not installed",
            where="--solver",
            value=solver,
            expected="pip install 'pytest-twin[ipopt]', or --solver scipy",
        ) from None
    return ipopt
