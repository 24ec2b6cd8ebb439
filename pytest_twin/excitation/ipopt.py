"""Minimize with IPOPT through casadi, for objectives with derivatives."""

from __future__ import annotations

from typing import Any

import casadi
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.excitation.minimizers import Objective

_MEMORY = 10
"""Number of steps in the approximate Hessian, as in scipy's L-BFGS-B."""
_ANY = 1e20
"""Optimality tolerance so large that only the change of the objective stops a run."""


def ipopt(objective: Objective, first: FloatArray, iterations: int, tolerance: float) -> FloatArray:
    """Return the (n,) minimum; see :class:`~pytest_twin.excitation.minimizers.Minimizer`."""
    value = _Value(objective, len(first))
    free = casadi.MX.sym("free", len(first))
    options = {
        "print_time": False,
        "show_eval_warnings": False,
        "ipopt": {
            "sb": "yes",
            "print_level": 0,
            "hessian_approximation": "limited-memory",
            "limited_memory_max_history": _MEMORY,
            "max_iter": iterations,
            "acceptable_tol": _ANY,
            "acceptable_iter": 1,
            "acceptable_obj_change_tol": tolerance,
        },
    }
    solver = casadi.nlpsol("solver", "ipopt", {"x": free, "f": value(free)}, options)
    # A long trial step can overflow: IPOPT shortens it if the value is not finite.
    with np.errstate(over="ignore", invalid="ignore"):
        solved = solver(x0=first)
    if value.error is not None:
        raise value.error
    return np.asarray(solved["x"], dtype=float).ravel()


class _Value(casadi.Callback):  # type: ignore[misc]
    """casadi function of the objective's value, with its gradient as Jacobian.

    Attributes:
        error: exception of the objective, which casadi would treat as a too long step, or None.
    """

    def __init__(self, objective: Objective, size: int) -> None:
        casadi.Callback.__init__(self)
        self._objective = objective
        self._at = np.full(size, np.nan)
        self._known: tuple[float, FloatArray] = (np.nan, self._at)
        self._size = size
        # casadi keeps no reference to the callback.
        self._gradient: _Gradient | None = None
        self.error: Exception | None = None
        self.construct("value", {})

    def get_n_in(self) -> int:
        return 1

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, index: int) -> Any:
        return casadi.Sparsity.dense(self._size)

    def get_sparsity_out(self, index: int) -> Any:
        return casadi.Sparsity.dense(1)

    def eval(self, arguments: Any) -> list[float]:
        return [self.known_at(arguments[0])[0]]

    def has_jacobian(self) -> bool:
        return True

    def get_jacobian(self, name: str, inputs: Any, outputs: Any, options: Any) -> _Gradient:
        self._gradient = _Gradient(self, name, self._size, options)
        return self._gradient

    def known_at(self, free: Any) -> tuple[float, FloatArray]:
        """Return value and (n,) gradient, cached because IPOPT requests them separately."""
        at = np.asarray(free, dtype=float).ravel()
        if not np.array_equal(at, self._at):
            try:
                self._known = self._objective(at)
            except Exception as error:
                self.error = error
                raise
            self._at = at
        return self._known


class _Gradient(casadi.Callback):  # type: ignore[misc]
    """casadi function of the objective's (1, n) gradient."""

    def __init__(self, value: _Value, name: str, size: int, options: Any) -> None:
        casadi.Callback.__init__(self)
        self._value = value
        self._size = size
        self.construct(name, options)

    def get_n_in(self) -> int:
        return 2

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, index: int) -> Any:
        return casadi.Sparsity.dense(self._size if index == 0 else 1)

    def get_sparsity_out(self, index: int) -> Any:
        return casadi.Sparsity.dense(1, self._size)

    def eval(self, arguments: Any) -> list[FloatArray]:
        return [self._value.known_at(arguments[0])[1][None]]
