"""Bounds, as laws between steps need them: of few numbers, very often."""

from __future__ import annotations

import numpy as np

from pytest_twin.arrays import FloatArray


def within(x: FloatArray, low: FloatArray | float, high: FloatArray | float) -> FloatArray:
    """As ``np.clip``, at a third of what that costs few numbers."""
    bounded: FloatArray = np.minimum(np.maximum(x, low), high)
    return bounded
