"""Teleoperated episodes of a small arm: a leader's motion, and a follower that lags and sags."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

sys.path.append(str(Path(__file__).parents[1] / "formats"))
from lerobot_files import write_dataset

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
FPS = 30
COUNT = 360 / 4095
"""Degrees of one encoder count."""
START = np.array([0.0, -95.0, 90.0, 70.0, -5.0, 5.0])
Episode = dict[str, np.ndarray]


def demonstrations(
    episodes: int = 12, frames: int = 240, change: Callable[[int, Episode], None] | None = None
) -> list[Episode]:
    """Episodes in degrees, the gripper in per cent; ``change`` edits each before quantization."""
    made = []
    for number in range(episodes):
        random = np.random.default_rng(number)
        time = np.arange(frames) / FPS
        knots = np.linspace(0.0, time[-1], 7)
        reach = np.array([50.0, 60.0, 55.0, 50.0, 70.0, 0.0])
        goals = START + random.uniform(-1.0, 1.0, (7, 6)) * reach
        goals[0] = goals[-1] = START
        leader = CubicSpline(knots, goals, bc_type="clamped")
        # A hand on the leader moves a little irregularly.
        noise = np.cumsum(random.normal(0.0, 0.05, (frames, 6)), axis=0)
        action = leader(time) + noise
        closes = 1.0 / (1.0 + np.exp(-8.0 * (time - 3.0))) - 1.0 / (
            1.0 + np.exp(-8.0 * (time - 6.0))
        )
        action[:, 5] = 60.0 - 55.0 * closes
        state = leader(time - 0.09) + np.interp(time - 0.09, time, noise[:, 0])[:, None]
        state[:, 1:3] += [-1.2, 1.5]
        # An object keeps the gripper open.
        state[:, 5] = np.maximum(np.interp(time - 0.09, time, action[:, 5]), 22.0)
        episode = {"time": time, "action": action, "state": state}
        if change is not None:
            change(number, episode)
        for name in ("action", "state"):
            episode[name] = np.round(episode[name] / COUNT) * COUNT
        made.append(episode)
    return made


def write(folder: Path, episodes: Sequence[Episode], version: str = "v3.0", **info: Any) -> Path:
    """Write episodes as LeRobot does."""
    names = tuple(f"{joint}.pos" for joint in JOINTS)
    info = {"total_frames": sum(len(one["time"]) for one in episodes), "units": "deg", **info}
    return write_dataset(folder, episodes, version, dtype="float32", names=names, fps=FPS, **info)


def calibration(folder: Path, half_range: int = 1400) -> Path:
    """The arm's calibration by LeRobot, each joint with this range around the middle."""
    motors = {
        joint: {"id": at, "drive_mode": 0, "homing_offset": -37, "range_min": 2048 - half_range,
                "range_max": 2048 + half_range}
        for at, joint in enumerate(JOINTS, 1)
    }  # fmt: skip
    path = folder / "arm.json"
    path.write_text(json.dumps(motors))
    return path
