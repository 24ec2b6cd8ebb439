"""Detect mistakes in recorded positions: degrees, gear ratios, and clipped readings."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.identification.effort.input_mistakes import InputMistake
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.realization import Realization

_OUTSIDE = 3.0
"""Ratio of the span of positions to the joint's range above which their unit or side is wrong."""
_ROOM = 1.1
"""Ratio of the span to the range up to which a correction explains the positions."""
_PLATEAU = 5
"""Fewest equal samples in a row at the highest or lowest position."""
_ABRUPT = 0.1
"""Steps before a plateau, relative to the largest step, above which the motion does not end there:
a joint that comes to rest slows down first."""
_STEPS = 5.0
"""Ratio of these steps to the resolution of the readings. One step may be a rounding."""
_FEWEST_PLATEAUS = 2


def position_mistakes(
    realization: Realization, recordings: Sequence[MeasuredRecording], gears: Sequence[float]
) -> list[InputMistake]:
    """Return suspected mistakes in the positions of joints.

    Args:
        recordings: fitted recordings, of the same joints.
        gears: (joints,) stated gear ratios, 1 by default.
    """
    found = []
    for k, joint in enumerate(recordings[0].joints):
        wide = _too_wide(realization, recordings, k, abs(gears[k]))
        found += [wide] if wide is not None else []
        columns = [one.position[:, k] for one in recordings]
        ends = [end for column in columns for end in clipped_ends(column)]
        if len(ends) >= _FEWEST_PLATEAUS:
            unit = realization.structure.joint_type[joint] == "slide"
            at = ", ".join(f"{end:.4g}" for end in sorted(set(ends)))
            found.append(InputMistake(
                joint,
                f"{joint}: positions stop in motion at {at} {'m' if unit else 'rad'}, {len(ends)} "
                "times: the readings are clipped, or the joint runs against a stop",
                "record within the range of the encoder and of the joint, or cut these parts off",
            ))  # fmt: skip
    return found


def clipped_ends(position: FloatArray) -> list[float]:
    """Return highest and lowest positions at which a motion is cut off, once for each time.

    Args:
        position: (n,) readings of one joint.
    """
    steps = np.abs(np.diff(position))
    moved = steps[steps > 0.0]
    if not len(moved):
        return []
    least = max(_ABRUPT * float(moved.max()), _STEPS * float(moved.min()))
    found = []
    for end in (float(position.max()), float(position.min())):
        there = np.concatenate([[False], position == end, [False]])
        edges = np.flatnonzero(np.diff(there.astype(np.int8)))
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            # The step onto the plateau and the one off it are cut off themselves.
            if first < 3 or last > len(position) - 3 or last - first < _PLATEAU:
                continue
            before, after = steps[first - 3 : first - 1][::-1], steps[last : last + 2]
            if _in_motion(before, least) and _in_motion(after, least):
                found.append(end)
    return found


def _in_motion(steps: FloatArray, least: float) -> bool:
    """Whether a motion goes on up to a plateau: two steps, the nearer first, that do not slow down.

    A joint that comes to rest slows down, and one that jumps within a sample has one large step.
    """
    return bool(steps[0] >= least and steps[1] >= least and steps[0] > 0.5 * steps[1])


def _too_wide(
    realization: Realization, recordings: Sequence[MeasuredRecording], k: int, gear: float
) -> InputMistake | None:
    """Return a suspicion if positions span far more than the joint's range."""
    joint = recordings[0].joints[k]
    model, index = realization.model, realization.joint_index(joint)
    low, high = model.jnt_range[index]
    if not model.jnt_limited[index] or high <= low:
        return None
    span = max(float(np.ptp(one.position[:, k])) for one in recordings)
    slide = realization.structure.joint_type[joint] == "slide"
    unit = "m" if slide else "rad"
    most = float(_ROOM * (high - low))
    if span <= _OUTSIDE * (high - low):
        return None
    ratio = max(gear, 1.0 / gear)
    side = f"signals: joints: {joint}: position: {{side: motor}}, and gear as turns of the motor"
    reasons = [
        ("they seem to be in degrees", f"signals: joints: {joint}: position: {{unit: deg}}",
         not slide and math.radians(span) <= most),
        (f"the gear ratio {gear:g} is not applied", side,
         ratio > _OUTSIDE and span / ratio <= most),
        (f"the gear ratio {gear:g} is applied the wrong way round",
         f"signals: joints: {joint}: gear: {1.0 / gear:g}",
         ratio > _OUTSIDE and most < span / ratio and span / ratio**2 <= most),
    ]  # fmt: skip
    fitting = [(what, mend) for what, mend, fits in reasons if fits] or [
        ("another unit, the motor's side of a gear, or another joint", side)
    ]
    return InputMistake(
        joint,
        f"{joint}: positions span {span:.4g} {unit}, its range is {high - low:.3g} {unit}: "
        + ", or ".join(what for what, _ in fitting),
        ", or ".join(mend for _, mend in fitting),
    )
