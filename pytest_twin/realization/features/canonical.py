"""Convert values of a model to canonical form, so that equal models give equal content."""

from __future__ import annotations

import hashlib
import math
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray


def with_unit(name: str, unit: str | None) -> str:
    """Return ``name [unit]``, or ``name`` without a unit."""
    return name if unit is None else f"{name} [{unit}]"


def number(value: Any) -> float | str:
    """Return a finite number as float, and any other as text, because JSON has no infinity."""
    number = float(value)
    return number if math.isfinite(number) else str(number)


def as_list(array: Any) -> Any:
    """An array as nested lists of numbers."""
    array = np.asarray(array)
    if array.ndim > 1:
        return [as_list(row) for row in array]
    return [number(value) for value in array]


def one_or_listed(array: Any) -> Any:
    """A single number, or a list of several numbers."""
    values = as_list(array)
    return values[0] if len(values) == 1 else values


def as_rounded_list(array: Any) -> Any:
    """Positions (m), axes and joint values, rounded to 1e-12; smaller digits depend on notation."""
    return as_list(np.round(np.asarray(array, dtype=np.float64), 12) + 0.0)


def rotation_of(quaternion: NDArray[np.float64]) -> Any:
    """The quaternion of a rotation whose first non-zero component is positive, rounded to 1e-12."""
    rounded = np.round(quaternion, 12)
    first = rounded[np.flatnonzero(rounded)[:1]]
    return as_list(rounded * (-1.0 if first.size and first[0] < 0 else 1.0) + 0.0)


def tensor_of(quaternion: NDArray[np.float64], diagonal: NDArray[np.float64]) -> Any:
    """Inertia xx yy zz xy xz yz in body axes; principal axes are not unique."""
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, quaternion)
    rotation = flat.reshape(3, 3)
    tensor = rotation @ np.diag(diagonal) @ rotation.T
    scale = float(np.abs(tensor).max()) or 1.0
    values = tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return as_list((np.round(values / scale, 10) + 0.0) * scale)


def rows_of_element(
    array: NDArray[Any], starts: NDArray[Any], counts: NDArray[Any], index: int
) -> NDArray[Any]:
    """Rows of one element in an array with the rows of all elements."""
    start = int(starts[index])
    return np.asarray(array[start : start + int(counts[index])])


def digest_of(array: Any) -> str:
    """SHA-256 of the bytes of an array, hex."""
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


def value_of(value: Any) -> Any:
    """JSON-able value of any field of a model; a long array is given by its digest."""
    if isinstance(value, bytes | str):
        data = value.encode() if isinstance(value, str) else value
        return hashlib.sha256(data).hexdigest()
    if isinstance(value, np.ndarray):
        if value.size > 16 or value.dtype.kind not in "fiub":
            return {"shape": list(value.shape), "sha256": digest_of(value)}
        return as_list(value)
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    return number(value) if isinstance(value, float | np.floating) else str(value)
