"""How loud sensors are, told from their samples alone."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.noise import effort_noise, sensor_noise, timing_jitter
from pytest_twin.diagnosis.windows import edges_of
from pytest_twin.effects.segment import Predicted, Segment

SAMPLES, INTERVAL, COUNT = 1200, 0.01, 2.0 * np.pi / 4096


def swing(time: FloatArray, amplitude: float) -> FloatArray:
    return np.asarray(amplitude * np.sin(2.0 * np.pi * 0.7 * time))


@given(
    noise=st.floats(5e-5, 2e-3),
    amplitude=st.floats(0.02, 1.0),
    jitter=st.floats(0.0, 0.2),
    seed=st.integers(0, 1000),
)
def test_noise_and_counts_add_up(noise: float, amplitude: float, jitter: float, seed: int) -> None:
    """A coarse encoder, irregular sampling, slow and fast motion: the deviation stays the same."""
    random = np.random.default_rng(seed)
    time = INTERVAL * (np.arange(SAMPLES) + jitter * random.uniform(-0.5, 0.5, SAMPLES))
    read = swing(time, amplitude) + noise * random.standard_normal(SAMPLES)
    counted = COUNT * np.round(read / COUNT)
    truth = float(np.sqrt(np.mean((counted - swing(time, amplitude)) ** 2)))
    assert sensor_noise(time, counted[:, None])[0] == pytest.approx(truth, rel=0.25)


def test_what_moves_fast_is_not_noise() -> None:
    """A motion that no cubic follows over fifteen samples: third differences still do."""
    random = np.random.default_rng(0)
    time = INTERVAL * np.arange(SAMPLES)
    fast = np.sin(2.0 * np.pi * 4.0 * time) + 1e-3 * random.standard_normal(SAMPLES)
    assert sensor_noise(time, fast[:, None])[0] < 5e-3


@pytest.mark.parametrize("noise", [1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize(
    ("rate", "lost"), [(50.0, 0.0), (50.0, 0.2), (100.0, 0.2), (250.0, 0.2)], ids=str
)
def test_noise_at_low_rates_with_samples_lost(rate: float, lost: float, noise: float) -> None:
    """Three sines of up to 1.6 Hz, as a drive follows them: what moves is no noise."""
    found = []
    for seed in range(8):
        random = np.random.default_rng(seed)
        time = np.arange(int(20.0 * rate)) / rate
        time = time[random.uniform(size=len(time)) >= lost]
        waves = random.uniform(0.3, 1.6, 3), random.uniform(0.0, 2.0 * np.pi, 3)
        motion = sum(0.3 * np.sin(2.0 * np.pi * f * time + p) for f, p in zip(*waves, strict=True))
        read = motion + noise * random.standard_normal(len(time))
        found.append(sensor_noise(time, read[:, None])[0] / noise)
    assert np.median(found) == pytest.approx(1.0, abs=0.2)
    assert max(found) < 1.6


def test_too_few_samples_have_a_noise_too() -> None:
    random = np.random.default_rng(1)
    time = INTERVAL * np.arange(20)
    few = 1e-3 * random.standard_normal((20, 1))
    assert 3e-4 < sensor_noise(time, few)[0] < 3e-3


def test_windows_begin_where_nothing_jumps() -> None:
    """A kink of the motion in the middle of where a window would begin."""
    time = INTERVAL * np.arange(301)
    random = np.random.default_rng(2)
    off = 1e-4 * random.standard_normal((301, 1))
    beside = np.abs(time - 0.5) < 0.06
    off[beside] += 1e-2
    edges = edges_of(time, off, 0.5)
    assert len(edges) == 7
    assert (np.diff(edges) > 0.2).all()
    assert abs(edges[1] - 0.5) > 0.06
    assert edges[0] == 0.0
    assert edges[-1] == pytest.approx(time[-1])


def test_an_effort_sensor_is_as_loud_as_in_most_trials() -> None:
    """Efforts of a stiff servo jump at every command in two of five trials: no louder sensor."""
    random = np.random.default_rng(3)
    time = INTERVAL * np.arange(400)
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    still = np.zeros((400, 1))
    segments, nominal = [], []
    for trial in range(5):
        jumps = random.standard_normal((400, 1)) if trial < 2 else still
        effort = jumps + 0.05 * random.standard_normal((400, 1))
        segments.append(
            Segment(trial, model, "position", 0.0, time, still, None, effort, time, still,
                    still[0], still[0])
        )  # fmt: skip
        nominal.append(Predicted(still, still, still))
    assert effort_noise(segments, nominal, range(5)) == pytest.approx(0.05, rel=0.2)


@pytest.mark.parametrize("noise", [2e-5, 1e-3])
@pytest.mark.parametrize("jitter", [0.0, 3e-4, 1e-3])
def test_jitter_of_stamps_is_told_from_noise(noise: float, jitter: float) -> None:
    """Samples at times that their stamps miss: noise that grows with speed, and no other."""
    rng = np.random.default_rng(3)
    time = 0.005 * np.arange(2400)
    taken = time + jitter * rng.standard_normal(len(time))
    waves = rng.uniform(0.3, 1.8, (2, 3, 3))
    turns = (2 * np.pi * np.outer(taken, f) + p for f, p in zip(*waves, strict=True))
    moved = 0.3 * np.sum([np.sin(turn) for turn in turns], axis=0)
    found = timing_jitter(time, moved + noise * rng.standard_normal(moved.shape))
    # Noise of 1 mrad, at some rad/s, may pass for a tenth of a millisecond.
    assert found == pytest.approx(jitter, rel=0.1, abs=0.1 * noise)


def test_short_and_resting_recordings_tell_no_jitter() -> None:
    time = 0.005 * np.arange(2400)
    assert timing_jitter(time[:60], np.zeros((60, 2))) == 0.0
    assert timing_jitter(time, np.zeros((2400, 2))) == 0.0
