"""Measure the processor time of two calibrations: from 2 MP images, and of a whole arm's geometry.

    python benchmarks/calibration/speed.py

The processor time of all threads depends far less on the load of the machine than wall-clock time.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

TESTS = Path(__file__).parents[2] / "tests" / "calibration"
sys.path[:0] = [str(TESTS), str(TESTS / "boards"), str(TESTS / "images")]
import cells  # noqa: E402
import test_calibrate_images as images  # noqa: E402

from pytest_twin.calibration.calibrate import calibrate, calibrate_file  # noqa: E402

IMAGES, WIDTH, HEIGHT = 20, 1632, 1224
"""2.0 MP."""
POSES, JOINTS = 100, 14
"""Fourteen joints have 60 unknowns and more."""


def of_images() -> str:
    """Calibrate hand-eye, robot-world and intrinsics from image files."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        images.write_cell(folder, count=IMAGES)
        for path in (folder / "images").iterdir():
            # Enlarged with the camera's intrinsics, which are unknown here.
            large = cv2.resize(cv2.imread(str(path), 0), (WIDTH, HEIGHT))
            cv2.imwrite(str(path), large)
        seconds, found = timed(lambda: calibrate_file(str(folder / "plan.yaml")))
    return f"{IMAGES} images of {WIDTH} x {HEIGHT}: {seconds:.1f} s, {found['verdict']}"


def of_geometry() -> str:
    """Calibrate zeros, links, hand-eye and base of an arm with many joints from poses."""
    rng = np.random.default_rng(6)
    chain = cells.arm(JOINTS, rng)
    cell = cells.joint_cell(rng, chain, round(POSES / 0.8), zeros=rng.normal(0.0, 0.01, JOINTS))
    plan = cells.plan("geometry", "joint_zeros", "hand_eye", "base_world")
    seconds, found = timed(lambda: calibrate(plan, cell.observations, chain))
    unknowns = len(found["covariance"]["of"])
    return (
        f"{found['fitted']['count']} poses, {unknowns} unknowns: {seconds:.1f} s, "
        f"{found['verdict']}"
    )


def timed(task: Callable[[], dict]) -> tuple[float, dict]:
    """Return processor time, s, and the result of the task."""
    before = time.process_time()
    found = task()
    return time.process_time() - before, found


if __name__ == "__main__":
    # The first run loads libraries too.
    for case in (of_images, of_geometry):
        for run in ("first", "second"):
            print(f"{run} run: {case()}", flush=True)
