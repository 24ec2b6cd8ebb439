"""Set recorded numbers to zero that are rounding errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pytest_twin.trace import Trace

SMALLEST = 1e-12
"""In SI units. Values of robots (m, rad, N*m, J, up to 1e3) in double precision have rounding
errors of 1e-16 to 1e-13, which differ between machines. No result of a robot is that small: 1e-12 m
is less than the size of an atom.
"""


def without_rounding_errors(
    expected: Mapping[str, Any], trace: Trace | None
) -> tuple[dict[str, Any], Trace | None]:
    """Return expected values and trace with all numbers below ``SMALLEST`` set to zero."""
    values = {name: _round(value) for name, value in expected.items()}
    if trace is None:
        return values, None
    columns = {
        name: (unit, np.where(np.abs(series) < SMALLEST, 0.0, series))
        for name, (unit, series) in trace.columns.items()
    }
    return values, Trace(trace.axis, trace.x, columns)


def _round(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _round(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_round(item) for item in value]
    if isinstance(value, float) and abs(value) < SMALLEST:
        return 0.0
    return value
