"""Frequency responses of recordings compared with known filters."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from pytest_twin.metrics.frequency import bandwidth, decibel, resonance
from pytest_twin.metrics.recorded_frequency import (
    compare_responses,
    recorded_response,
    resample_uniformly,
)

RATE = 200.0


def noise(samples: int = 20000, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(samples)


def second_order(hertz: float, damping: float) -> np.ndarray:
    w = 2 * np.pi * hertz
    return signal.tf2sos(*signal.bilinear([w**2], [1, 2 * damping * w, w**2], RATE))


def test_magnitude_and_phase_equal_those_of_a_known_filter() -> None:
    sections = second_order(8.0, 0.5)
    command = noise()
    found = recorded_response(command, signal.sosfilt(sections, command), RATE)
    assert found is not None
    _, true = signal.sosfreqz(sections, found.frequency, fs=RATE)
    low = found.frequency < 20.0
    assert low.sum() > 50
    np.testing.assert_allclose(decibel(found.magnitude)[low], decibel(np.abs(true))[low], atol=0.5)
    np.testing.assert_allclose(found.phase[low], np.unwrap(np.angle(true))[low], atol=0.06)


def test_bandwidth_and_resonance_of_a_second_order_filter_are_found() -> None:
    command = noise()
    answer = recorded_response(command, signal.sosfilt(second_order(8.0, 0.2), command), RATE)
    assert answer is not None
    peak = resonance(answer)
    assert peak is not None
    assert peak[0] == pytest.approx(8.0 * np.sqrt(1 - 2 * 0.2**2), rel=0.05)
    assert bandwidth(answer) == pytest.approx(8.0 * 1.51, rel=0.08)


def test_frequencies_that_the_command_does_not_excite_are_left_out() -> None:
    command = signal.sosfiltfilt(signal.butter(6, 3.0, fs=RATE, output="sos"), noise())
    response = command + 1e-3 * noise(seed=1)
    found = recorded_response(command, response, RATE)
    assert found is not None
    assert found.frequency.max() < 10.0


def test_a_response_unrelated_to_the_command_has_no_frequency() -> None:
    found = recorded_response(noise(seed=1), noise(seed=2), RATE)
    assert found is not None
    assert found.frequency.size == 0
    assert compare_responses(noise(seed=1), noise(seed=1), noise(seed=2), RATE) is None


def test_a_too_short_recording_has_no_response() -> None:
    assert recorded_response(noise(100), noise(100), RATE) is None


def test_a_delay_changes_only_the_phase() -> None:
    command = signal.sosfiltfilt(signal.butter(4, 10.0, fs=RATE, output="sos"), noise())
    found = compare_responses(command, np.roll(command, 2), command, RATE)
    assert found is not None
    assert found.magnitude < 0.5
    assert found.phase == pytest.approx(2 * np.pi * found.phase_at * 2 / RATE, rel=0.1)
    assert found.phase_at == found.highest


def test_bandwidths_and_resonances_of_two_responses_are_compared() -> None:
    command = noise()
    slow, quick = (signal.sosfilt(second_order(hertz, 0.2), command) for hertz in (8.0, 10.0))
    found = compare_responses(command, quick, slow, RATE)
    assert found is not None
    assert found.resonance == pytest.approx(2.0 * np.sqrt(1 - 2 * 0.2**2), rel=0.15)
    assert found.bandwidth == pytest.approx(2.0 * 1.51, rel=0.15)
    assert found.bandwidth_predicted is not None
    assert found.bandwidth_measured is not None
    assert found.bandwidth_predicted > found.bandwidth_measured
    damped = signal.sosfilt(second_order(8.0, 1.0), command)
    without = compare_responses(command, damped, slow, RATE)
    assert without is not None
    assert without.resonance is None
    assert without.resonance_measured is not None


def test_irregular_stamps_are_resampled_to_a_uniform_rate() -> None:
    time = np.cumsum(np.random.default_rng(0).uniform(0.004, 0.006, 2000))
    rate, (wave,) = resample_uniformly(time, np.sin(2 * np.pi * time))
    assert rate == pytest.approx(200.0, rel=0.01)
    grid = time[0] + np.arange(len(wave)) / rate
    np.testing.assert_allclose(wave, np.sin(2 * np.pi * grid), atol=1e-3)
