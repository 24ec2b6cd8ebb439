"""The filter follows the motion, and not the trembling of joints that are held."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pytest_twin.identification.effort.filtering import choose_filter
from pytest_twin.identification.measured_recordings import MeasuredRecording

TIME = np.arange(0.0, 20.0, 0.005)


def recording(first: np.ndarray, second: np.ndarray) -> MeasuredRecording:
    noise = 2e-6 * np.random.default_rng(0).standard_normal((len(TIME), 2))
    return MeasuredRecording(
        Path("run.csv"), 0.0, ("shoulder", "elbow"), TIME, np.column_stack([first, second]) + noise,
        None, np.zeros((len(TIME), 2)), np.zeros(2, dtype=bool), np.full(2, np.inf), {},
    )  # fmt: skip


def test_a_held_joint_that_trembles_leaves_the_filter_as_it_is() -> None:
    motion = 0.5 * np.sin(2 * np.pi * 0.5 * TIME)
    tremble = 1e-4 * np.sin(2 * np.pi * 15.0 * TIME)
    still = np.zeros_like(TIME)
    calm = choose_filter([recording(motion, still), recording(still, motion)])
    trembling = choose_filter([recording(motion, tremble), recording(tremble, motion)])
    assert trembling.parallel == pytest.approx(calm.parallel, rel=0.05)
    # Alone, nothing but the tremble is the joint's motion.
    assert choose_filter([recording(motion, tremble)]).parallel > 5.0 * calm.parallel
