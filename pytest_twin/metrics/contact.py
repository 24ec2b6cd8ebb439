"""What a contact shows in time: onset, slip, rebound.

A metric that the contact does not carry is None, never a guess.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray

BoolArray = NDArray[np.bool_]

TAIL = 0.1
"""Fraction of the time, at its end, over which rest is averaged."""
_SATURATED = 0.99  # of the friction while it slides
_STEADY = 0.05  # spread of the friction while it slides; more is a creep, not a slip


@dataclass(frozen=True, slots=True)
class Slip:
    """Sliding under a growing tangential force.

    Attributes:
        friction: tangential over normal force while it slides.
        time: s, when the ratio first comes within 1 % of it.
        force: N, the applied tangential force then.
    """

    friction: float
    time: float
    force: float


@dataclass(frozen=True, slots=True)
class Rebound:
    """First bounce of a body that was let go.

    Attributes:
        height: m above where it touched first, 0 where it does not leave again.
        restitution: speed of leaving over speed of impact (Newton's coefficient).
    """

    height: float
    restitution: float


def onset(touching: BoolArray) -> int | None:
    """Index of the first sample in contact, None without any."""
    found = np.flatnonzero(touching)
    return int(found[0]) if found.size else None


def at_rest(time: FloatArray, values: FloatArray, touching: BoolArray) -> float | None:
    """Mean over the last tenth of the time, None where the contact is not there throughout."""
    tail = time >= time[-1] - TAIL * (time[-1] - time[0])
    return float(np.mean(values[tail])) if touching[tail].all() else None


def slip(
    time: FloatArray,
    normal: FloatArray,
    tangential: FloatArray,
    applied: FloatArray,
    travel: FloatArray,
    *,
    least_travel: float,
) -> Slip | None:
    """Time and friction coefficient at which a contact slips; None if it does not slip.

    Soft contacts creep under any tangential force, so saturation shows slip: friction is the
    median ratio of tangential to normal force over the samples beyond ``least_travel``, if nine
    of ten lie within 5 % of it, and slip starts where the ratio first comes within 1 % of it.

    Args:
        time: (n,) s.
        normal, tangential: (n,) N.
        applied: (n,) N, the tangential force from outside.
        travel: (n,) m along the surface.
    """
    sliding = (travel > least_travel) & (normal > 0.0)
    if not sliding.any():
        return None
    ratio = np.divide(tangential, normal, out=np.zeros_like(normal), where=normal > 0.0)
    friction = float(np.median(ratio[sliding]))
    if friction == 0.0:
        return Slip(0.0, float(time[sliding][0]), float(applied[sliding][0]))
    if np.quantile(np.abs(ratio[sliding] / friction - 1.0), 0.9) > _STEADY:
        return None
    start = int(np.flatnonzero(ratio >= _SATURATED * friction)[0])
    return Slip(friction=friction, time=float(time[start]), force=float(applied[start]))


def rebound(height: FloatArray, velocity: FloatArray, touching: BoolArray) -> Rebound | None:
    """First bounce; None where it never touches or does not come down on it.

    Args:
        height: (n,) m, of the body's centre.
        velocity: (n,) m/s, its rate.
        touching: (n,)
    """
    first = onset(touching)
    if first is None or first == 0 or velocity[first] >= 0.0:
        return None
    left = np.flatnonzero(~touching[first:])
    if left.size == 0:
        return Rebound(0.0, 0.0)
    leave = first + int(left[0])
    again = onset(touching[leave:])
    end = height.size if again is None else leave + again
    rise = float(height[leave:end].max() - height[first])
    return Rebound(max(0.0, rise), max(0.0, float(-velocity[leave] / velocity[first])))
