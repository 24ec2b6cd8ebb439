"""Noise of sensors and jitter of time stamps, estimated from the samples alone."""

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


def sine_motion(time: FloatArray, amplitude: float) -> FloatArray:
    return np.asarray(amplitude * np.sin(2.0 * np.pi * 0.7 * time))


@given(
    noise=st.floats(5e-5, 2e-3),
    amplitude=st.floats(0.02, 1.0),
    jitter=st.floats(0.0, 0.2),
    seed=st.integers(0, 1000),
)
def test_the_noise_contains_sensor_noise_and_quantization(
    noise: float, amplitude: float, jitter: float, seed: int
) -> None:
    """For coarse encoders, irregular sampling, slow and fast motion."""
    random = np.random.default_rng(seed)
    time = INTERVAL * (np.arange(SAMPLES) + jitter * random.uniform(-0.5, 0.5, SAMPLES))
    read = sine_motion(time, amplitude) + noise * random.standard_normal(SAMPLES)
    counted = COUNT * np.round(read / COUNT)
    truth = float(np.sqrt(np.mean((counted - sine_motion(time, amplitude)) ** 2)))
    assert sensor_noise(time, counted[:, None])[0] == pytest.approx(truth, rel=0.25)


def test_fast_motion_is_not_counted_as_noise() -> None:
    """No cubic fits this motion over fifteen samples, but its third differences stay small."""
    random = np.random.default_rng(0)
    time = INTERVAL * np.arange(SAMPLES)
    fast = np.sin(2.0 * np.pi * 4.0 * time) + 1e-3 * random.standard_normal(SAMPLES)
    assert sensor_noise(time, fast[:, None])[0] < 5e-3


@pytest.mark.parametrize("noise", [1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize(
    ("rate", "lost"), [(50.0, 0.0), (50.0, 0.2), (100.0, 0.2), (250.0, 0.2)], ids=str
)
def test_noise_is_right_at_low_sampling_rates_with_lost_samples(
    rate: float, lost: float, noise: float
) -> None:
    """Three sines of up to 1.6 Hz, as a drive follows them."""
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


def test_twenty_samples_are_enough_for_a_noise_estimate() -> None:
    random = np.random.default_rng(1)
    time = INTERVAL * np.arange(20)
    few = 1e-3 * random.standard_normal((20, 1))
    assert 3e-4 < sensor_noise(time, few)[0] < 3e-3


def test_windows_begin_away_from_jumps() -> None:
    """A jump at the time at which a window would begin."""
    time = INTERVAL * np.arange(301)
    random = np.random.default_rng(2)
    deviation = 1e-4 * random.standard_normal((301, 1))
    near_jump = np.abs(time - 0.5) < 0.06
    deviation[near_jump] += 1e-2
    edges = edges_of(time, deviation, 0.5)
    assert len(edges) == 7
    assert (np.diff(edges) > 0.2).all()
    assert abs(edges[1] - 0.5) > 0.06
    assert edges[0] == 0.0
    assert edges[-1] == pytest.approx(time[-1])


def test_the_noise_of_an_effort_sensor_is_that_of_most_trials() -> None:
    """In two of five trials, the effort of a stiff servo jumps at every command."""
    random = np.random.default_rng(3)
    time = INTERVAL * np.arange(400)
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    at_rest = np.zeros((400, 1))
    segments, nominal = [], []
    for trial in range(5):
        jumps = random.standard_normal((400, 1)) if trial < 2 else at_rest
        effort = jumps + 0.05 * random.standard_normal((400, 1))
        segments.append(
            Segment(trial, model, "position", 0.0, time, at_rest, None, effort, time, at_rest,
                    at_rest[0], at_rest[0])
        )  # fmt: skip
        nominal.append(Predicted(at_rest, at_rest, at_rest))
    assert effort_noise(segments, nominal, range(5)) == pytest.approx(0.05, rel=0.2)


@pytest.mark.parametrize("noise", [2e-5, 1e-3])
@pytest.mark.parametrize("jitter", [0.0, 3e-4, 1e-3])
def test_timing_jitter_is_distinguished_from_sensor_noise(noise: float, jitter: float) -> None:
    """Sampling times differ from their stamps, which causes noise in proportion to velocity."""
    rng = np.random.default_rng(3)
    time = 0.005 * np.arange(2400)
    sampled = time + jitter * rng.standard_normal(len(time))
    waves = rng.uniform(0.3, 1.8, (2, 3, 3))
    phases = (2 * np.pi * np.outer(sampled, f) + p for f, p in zip(*waves, strict=True))
    position = 0.3 * np.sum([np.sin(turn) for turn in phases], axis=0)
    found = timing_jitter(time, position + noise * rng.standard_normal(position.shape))
    # At some rad/s, a noise of 1 mrad may count as 0.1 ms of jitter.
    assert found == pytest.approx(jitter, rel=0.1, abs=0.1 * noise)


def test_short_recordings_and_recordings_at_rest_give_no_jitter() -> None:
    time = 0.005 * np.arange(2400)
    assert timing_jitter(time[:60], np.zeros((60, 2))) == 0.0
    assert timing_jitter(time, np.zeros((2400, 2))) == 0.0
