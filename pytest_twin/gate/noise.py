"""Numbers that are recorded as zero, because they are rounding and not a result."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pytest_twin.trace import Trace

SMALLEST = 1e-12
"""In SI units. Doubles of robots (m, rad, N*m, J, up to 1e3) carry rounding of 1e-16 to 1e-13,
which differs between machines. Nothing that a robot does is as small: 1e-12 m is less than an atom.
"""


def without_noise(
    expected: Mapping[str, Any], trace: Trace | None
) -> tuple[dict[str, Any], Trace | None]:
    """What is recorded of a golden: values and series with what is below ``SMALLEST`` as zero."""
    values = {name: _rounded(value) for name, value in expected.items()}
    if trace is None:
        return values, None
    columns = {
        name: (unit, np.where(np.abs(series) < SMALLEST, 0.0, series))
        for name, (unit, series) in trace.columns.items()
    }
    return values, Trace(trace.axis, trace.x, columns)


def _rounded(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _rounded(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    if isinstance(value, float) and abs(value) < SMALLEST:
        return 0.0
    return value
