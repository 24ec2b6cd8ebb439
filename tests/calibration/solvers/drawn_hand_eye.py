"""Random hand-eye cells: poses with noise, for both camera mounts."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.calibration.cameras.increments import apply_change
from pytest_twin.metrics.pose import inverse


def pose(rng: np.random.Generator, turn: float, shift: float) -> np.ndarray:
    return apply_change(np.eye(4), np.r_[rng.normal(0, shift, 3), rng.normal(0, turn, 3)])


def random_hand_eye(mount: str, count: int, seed: int, noise: float = 0.0):
    """``base_from_flange``, ``camera_from_target``, and the true hand-eye and robot-world poses."""
    rng = np.random.default_rng(seed)
    hand_eye, robot_world = pose(rng, 0.5, 0.1), pose(rng, 0.5, 0.8)
    looking = np.eye(4)
    looking[:3, :3] = Rotation.from_euler("x", np.pi).as_matrix()
    looking[:3, 3] = [0.0, 0.0, 0.6]
    seen = np.array([looking @ pose(rng, 0.35, 0.08) for _ in range(count)])
    if mount == "hand":
        flange = robot_world @ inverse(seen) @ inverse(hand_eye)
    else:
        flange = robot_world @ seen @ inverse(hand_eye)
    steps = noise * rng.normal(size=(2, count, 6))
    return apply_change(flange, steps[0]), apply_change(seen, steps[1]), hand_eye, robot_world
