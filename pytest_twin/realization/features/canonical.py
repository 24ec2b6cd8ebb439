"""Values that are the same wherever they mean the same, however they were written."""

from __future__ import annotations

import hashlib
import math
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray


def with_unit(name: str, unit: str | None) -> str:
    """``name [unit]``, where there is a unit."""
    return name if unit is None else f"{name} [{unit}]"


def number(value: Any) -> float | str:
    """JSON knows no infinity."""
    number = float(value)
    return number if math.isfinite(number) else str(number)


def listed(array: Any) -> Any:
    """An array as nested lists of numbers."""
    array = np.asarray(array)
    if array.ndim > 1:
        return [listed(row) for row in array]
    return [number(value) for value in array]


def one_or_listed(array: Any) -> Any:
    """The number itself where there is one."""
    values = listed(array)
    return values[0] if len(values) == 1 else values


def placed(array: Any) -> Any:
    """Positions in m, axes, joint values: what is under 1e-12 comes from how it was written."""
    return listed(np.round(np.asarray(array, dtype=np.float64), 12) + 0.0)


def rotation_of(quaternion: NDArray[np.float64]) -> Any:
    """One of the two quaternions of a rotation."""
    rounded = np.round(quaternion, 12)
    first = rounded[np.flatnonzero(rounded)[:1]]
    return listed(rounded * (-1.0 if first.size and first[0] < 0 else 1.0) + 0.0)


def tensor_of(quaternion: NDArray[np.float64], diagonal: NDArray[np.float64]) -> Any:
    """xx yy zz xy xz yz in the body's axes: principal axes may be written in many ways."""
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, quaternion)
    rotation = flat.reshape(3, 3)
    tensor = rotation @ np.diag(diagonal) @ rotation.T
    scale = float(np.abs(tensor).max()) or 1.0
    values = tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return listed((np.round(values / scale, 10) + 0.0) * scale)


def stretch_of(
    array: NDArray[Any], starts: NDArray[Any], counts: NDArray[Any], index: int
) -> NDArray[Any]:
    """The rows of one element, of all elements' rows in one array."""
    start = int(starts[index])
    return np.asarray(array[start : start + int(counts[index])])


def digest_of(array: Any) -> str:
    """Of the bytes of an array."""
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


def value_of(value: Any) -> Any:
    """Any field: short ones as they are, long ones as their digest."""
    if isinstance(value, bytes | str):
        data = value.encode() if isinstance(value, str) else value
        return hashlib.sha256(data).hexdigest()
    if isinstance(value, np.ndarray):
        if value.size > 16 or value.dtype.kind not in "fiub":
            return {"shape": list(value.shape), "sha256": digest_of(value)}
        return listed(value)
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    return number(value) if isinstance(value, float | np.floating) else str(value)
