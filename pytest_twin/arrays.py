"""Type aliases of arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

# The type is a string so that the collection of specs does not import NumPy.
FloatArray: TypeAlias = "NDArray[np.float64]"
