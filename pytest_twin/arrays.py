"""Types of arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

# A name in quotes: collecting specs needs no arrays and should not wait for NumPy.
FloatArray: TypeAlias = "NDArray[np.float64]"
