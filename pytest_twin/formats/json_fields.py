"""Fields of JSON-encoded ROS messages."""

from __future__ import annotations

import json
import math

import numpy as np

from pytest_twin.formats import limits
from pytest_twin.formats.ros_serialization import Floats, MessageError, check_names


def object_of(message: bytes) -> dict[str, object]:
    """Parse a message that has to be a JSON object.

    Raises:
        MessageError: the message is not a JSON object.
    """
    try:
        found = json.loads(message)
    except (ValueError, RecursionError) as error:
        raise MessageError(f"not JSON: {str(error)[:80]}") from None
    if not isinstance(found, dict):
        raise MessageError("not a JSON object")
    return found


def names_of(found: object, field: str = "name") -> list[str]:
    """Return the joint names of a field.

    Raises:
        MessageError: the value is not a list of distinct names.
    """
    if not isinstance(found, list) or not all(isinstance(name, str) for name in found):
        raise MessageError(f"{field} is not a list of text")
    if len(found) > limits.MCAP.joints_count:
        raise MessageError(f"{len(found)} joints, more than {limits.MCAP.joints_count}")
    check_names(found)
    return found


def stamp_of(header: object) -> tuple[int, int]:
    """Return ``header.stamp`` in ns (0 if missing), and 1 if ``nanosec`` is out of range, else 0.

    The stamp is ``{"sec": ..., "nanosec": ...}``; ``nsec`` is accepted too.

    Raises:
        MessageError: the fields are not whole numbers in the range of ROS.
    """
    stamp = header.get("stamp") if isinstance(header, dict) else None
    if stamp is None:
        return 0, 0
    return time_of(stamp, "header.stamp")


def time_of(stamp: object, field: str) -> tuple[int, int]:
    """Return a time or duration in ns, and 1 if ``nanosec`` is out of range, else 0.

    Raises:
        MessageError: the fields are not whole numbers in the range of ROS.
    """
    if not isinstance(stamp, dict):
        raise MessageError(f"{field} is not an object")
    sec, nanosec = stamp.get("sec"), stamp.get("nanosec", stamp.get("nsec"))
    for name, value, low, high in (("sec", sec, -(2**31), 2**31), ("nanosec", nanosec, 0, 2**32)):
        if type(value) is not int or not low <= value < high:
            raise MessageError(f"{field}.{name} is not a whole number in range")
    assert isinstance(sec, int)
    assert isinstance(nanosec, int)
    return sec * 1_000_000_000 + nanosec, int(nanosec >= 1_000_000_000)


def values_of(found: object, field: str, joints: int) -> Floats | None:
    """Return (1, j) values, NaN for ``null`` (JSON writers' form of NaN); None for an empty field.

    Raises:
        MessageError: the field is not a list with one number per joint.
    """
    if found is None or found == []:
        return None
    if not isinstance(found, list):
        raise MessageError(f"{field} is not a list")
    if len(found) != joints:
        raise MessageError(f"{len(found)} values of {field} for {joints} joints")
    if not all(value is None or type(value) in (int, float) for value in found):
        raise MessageError(f"{field} contains a value that is not a number")
    try:
        return np.array([[math.nan if v is None else float(v) for v in found]], dtype=np.float64)
    except OverflowError:
        raise MessageError(f"{field} holds a number out of range") from None
