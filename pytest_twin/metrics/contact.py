"""Metrics of a contact over time: onset, slip, rebound.

A metric that the signals do not determine is None.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray

BoolArray = NDArray[np.bool_]

TAIL = 0.1
"""Fraction of the time, at its end, over which the values at rest are averaged."""
_SATURATED = 0.99  # fraction of the sliding friction at which slip starts
_STEADY = 0.05  # largest relative spread of the friction in slip; with more the contact creeps


@dataclass(frozen=True, slots=True)
class Slip:
    """Sliding under a growing tangential force.

    Attributes:
        friction: ratio of tangential to normal force in sliding.
        time: time at which the ratio first comes within 1 % of ``friction``, s.
        force: applied tangential force at that time, N.
    """

    friction: float
    time: float
    force: float


@dataclass(frozen=True, slots=True)
class Rebound:
    """First bounce of a dropped body.

    Attributes:
        height: rise above the position of the first contact, m; 0 without a bounce.
        restitution: ratio of the speeds after and before the impact (Newton's coefficient).
    """

    height: float
    restitution: float


def onset(touching: BoolArray) -> int | None:
    """Index of the first sample in contact, None without contact."""
    found = np.flatnonzero(touching)
    return int(found[0]) if found.size else None


def at_rest(time: FloatArray, values: FloatArray, touching: BoolArray) -> float | None:
    """Mean over the last tenth of the time; None without contact in all of its samples."""
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

    Soft contacts creep under any tangential force, so that slip is detected from the saturation
    of the force ratio. Friction is the median ratio of tangential to normal force in the samples
    beyond ``least_travel``, if 90 % of them are within 5 % of it. Slip starts where the ratio first
    comes within 1 % of it.

    Args:
        time: (n,) s.
        normal, tangential: (n,) contact forces, N.
        applied: (n,) applied tangential force, N.
        travel: (n,) displacement along the surface, m.
        least_travel: displacement beyond which a sample counts as sliding, m.
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
    """First bounce of a falling body; None without an impact from above.

    Args:
        height: (n,) height of the body's centre, m.
        velocity: (n,) its vertical velocity, m/s.
        touching: (n,) whether it is in contact.
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
