"""Data for figures of two streams: their motion on one clock, and errors over the workspace."""

from __future__ import annotations

from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.clocks.correlation import angular_speed
from pytest_twin.calibration.clocks.offset import ClockFit, hand_times, spread_rows
from pytest_twin.calibration.clocks.streams import PoseStream
from pytest_twin.calibration.plan import Plan
from pytest_twin.calibration.problem import describe_pose
from pytest_twin.calibration.scene import frame
from pytest_twin.metrics.pose import inverse

_SHOWN_S, _STEP_S = 20.0, 0.05
"""Length of the plotted time segment of the angular speeds, and the time between samples."""
_ARROWS = 100
"""Largest number of arrows. Neighbouring poses have the same errors, so more arrows would
overlap."""


def angular_speeds(
    hand: PoseStream, camera: PoseStream, fit: ClockFit, middle: float, correlation: float
) -> dict[str, Any]:
    """Angular speeds of both streams, rad/s, in the segment where the hand's speed varies most.

    Times count from the beginning of the hand's stream, on the hand's clock.

    Args:
        fit: fit with the offset.
        middle: time of the camera's clock at which the offset holds, s.
        correlation: correlation of the angular speeds over the whole streams.
    """
    shifted = PoseStream(hand_times(camera, fit.offset, fit.drift, middle), camera.poses)
    low = max(hand.time[0], shifted.time[0])
    high = min(hand.time[-1], shifted.time[-1])
    time = np.arange(low, high, _STEP_S)
    mine, theirs = angular_speed(hand, time), angular_speed(shifted, time)
    length = min(round(_SHOWN_S / _STEP_S), len(time))
    sums = [np.r_[0.0, np.cumsum(values)] for values in (mine, mine**2)]
    mean, square = ((one[length:] - one[:-length]) / length for one in sums)
    start = int(np.argmax(square - mean**2))
    shown = slice(start, start + length)
    return {
        "offset": fit.offset,
        "correlation": correlation,
        "time": (time[shown] - hand.time[0]).tolist(),
        "hand": mine[shown].tolist(),
        "camera": theirs[shown].tolist(),
    }


def scene_of_streams(
    plan: Plan,
    hand: PoseStream,
    camera: PoseStream,
    seen: FloatArray,
    fit: ClockFit,
    middle: float,
    held_out: np.ndarray,
) -> dict[str, Any]:
    """Frames at one time and errors as arrows in the base, m, in the format of ``scene``.

    Args:
        plan: plan with the camera's mount.
        seen: (n, 4, 4) poses of the camera stream as ``robot_world`` carries them.
        middle: time of the camera's clock at which the offset holds, s.
        held_out: rows of the camera's stream that were held out.
    """
    rows, time = spread_rows(hand, camera, fit, middle, _ARROWS)
    carried = hand.at(time)
    flange = inverse(carried) if hand.is_inverted else carried
    error = (carried @ fit.target_in_hand(seen[rows]))[:, :3, 3]
    error = error - fit.solved.robot_world[:3, 3]
    if hand.is_inverted:
        error = np.einsum("nij,nj->ni", flange[:, :3, :3], error)
    place = flange[:, :3, 3]
    shown = int(np.argmin(np.linalg.norm(place - place.mean(axis=0), axis=1)))
    mounted, world = fit.solved.hand_eye, fit.solved.robot_world
    if hand.is_inverted:
        mounted, world = world, mounted
    held = set(held_out.tolist())
    names = {
        role: describe_pose(f"camera.{role}", plan.mount).split()[1]
        for role in ("mounted", "world")
    }
    return {
        "observation": f"{time[shown] - hand.time[0]:.2f} s after the hand's stream begins",
        "chain": [],
        "frames": [
            frame("base", np.eye(4)),
            frame(plan.flange or "hand", flange[shown]),
            frame(names["mounted"], flange[shown] @ mounted, on_flange=True),
            frame(names["world"], world),
        ],
        "arrows": [
            {
                "id": f"{stamp:.3f}",
                "kind": "held_out" if row in held else "fitted",
                "at": at.tolist(),
                "error": off.tolist(),
            }
            for row, stamp, at, off in zip(rows, camera.time[rows], place, error, strict=True)
        ],
    }
