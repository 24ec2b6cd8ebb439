"""The filter follows the motion, and not the trembling of joints that are held."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pytest_twin.identification.effort.filtering import choose_filter
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.signals import Signals

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


@pytest.mark.parametrize("seed", range(4))
def test_uneven_stamps_and_any_rate_give_the_same_filter(seed: int) -> None:
    random = np.random.default_rng(seed)
    stamps = np.cumsum(
        random.choice([0.0007, 0.001, 0.0012, 0.0088], 16000, p=[0.2, 0.6, 0.19, 0.01])
    )
    lines = 2 * np.pi * random.uniform(0.05, 0.5, 3)
    motion = np.sin(np.outer(stamps, lines) + random.uniform(0, 6, 3)) @ random.uniform(0.1, 0.5, 3)
    # A stamp is late by up to half a sample, and the encoder's own filter colours its noise.
    late = np.interp(stamps + random.uniform(0, 5e-4, len(stamps)), stamps, motion)
    noise = np.convolve(random.standard_normal(len(stamps)), np.ones(4) / 4, mode="same")
    reading = np.round(late + 2e-5 * noise, 4)
    whole = MeasuredRecording(
        Path("run.csv"), 0.0, ("shoulder",), stamps, reading[:, None], None,
        np.zeros((len(stamps), 1)), np.zeros(1, dtype=bool), np.full(1, np.inf), {},
    )  # fmt: skip
    chosen = [
        choose_filter([
            replace(whole, time=stamps[::every], position=reading[::every, None],
                    effort=whole.effort[::every])
        ])
        for every in (1, 3, 10)
    ]  # fmt: skip
    assert max(one.parallel for one in chosen) < 8.0
    for one in chosen[1:]:
        assert one.parallel == pytest.approx(chosen[0].parallel, rel=0.02)


def test_a_stated_filter_is_the_cutoff_of_the_fit() -> None:
    stated = Signals.from_json({"default": {"effort": {"filter": "Butterworth 2, 8 Hz"}}})
    motion = 0.5 * np.sin(2 * np.pi * 0.5 * TIME)
    own = recording(motion, motion)
    chosen = choose_filter([replace(own, filter_cutoff=stated.of("shoulder").filter_cutoff)])
    assert chosen.parallel == 8.0
    assert (
        Signals.from_json({"default": {"effort": {"filter": "1.2 kHz"}}}).of("a").filter_cutoff
        == 1200
    )
    assert (
        Signals.from_json({"default": {"effort": {"filter": "as shipped"}}}).of("a").filter_cutoff
        is None
    )


def test_slower_recordings_with_abrupt_turns_leave_the_filter_as_it_is() -> None:
    motion = 0.5 * np.sin(2 * np.pi * 0.5 * TIME)
    turns = 0.05 * np.abs((0.4 * TIME) % 2.0 - 1.0)
    alone = choose_filter([recording(motion, motion)])
    more = choose_filter([recording(motion, motion), *[recording(turns, turns)] * 5])
    assert more == alone
