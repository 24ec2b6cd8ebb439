"""Excitation signals and response estimators compared with closed-form transfer functions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from pytest_twin.metrics import frequency as f

SAMPLES, PERIOD = 2000, 4.0
STEP = PERIOD / SAMPLES


def crest(x: np.ndarray) -> float:
    return float(np.abs(x).max() / np.sqrt(np.mean(x**2)))


def filtered(command: np.ndarray, b: list[float], a: list[float]) -> np.ndarray:
    return signal.lfilter(b, a, command, axis=-1)


def excite(kind: str, lowest: int = 2, highest: int = 80) -> tuple[np.ndarray, np.ndarray]:
    """Command (realizations, 4 periods of samples) and the excited harmonics."""
    if kind == "chirp":
        lines = np.arange(lowest, highest + 1)
        rows = [f.chirp(SAMPLES, lowest, highest, i) for i in range(6)]
    else:
        lines = f.log_harmonics(lowest, highest, 25)
        rows = [f.multisine(SAMPLES, lines, (1, i)) for i in range(6)]
    return np.tile(np.stack(rows), (1, 4)), lines


def estimate(command: np.ndarray, response: np.ndarray, lines: np.ndarray, coherence: float = 0.95):
    shape = (command.shape[0], 2, SAMPLES)
    whole = slice(2 * SAMPLES, None)
    return f.frequency_response(
        command[:, whole].reshape(shape),
        response[:, whole].reshape(shape),
        lines,
        PERIOD,
        coherence=coherence,
    )


@pytest.mark.parametrize("kind", ["multisine", "chirp"])
def test_the_response_of_a_linear_filter_is_exact_up_to_rounding(kind: str) -> None:
    command, lines = excite(kind)
    b, a = signal.butter(2, 0.02)
    found = estimate(command, filtered(command, b, a), lines)
    _, expected = signal.freqz(b, a, worN=2.0 * np.pi * found.frequency * STEP)
    assert found.frequency.size == lines.size
    np.testing.assert_allclose(found.magnitude, np.abs(expected), rtol=1e-8)
    np.testing.assert_allclose(found.phase, np.unwrap(np.angle(expected)), atol=1e-8)
    np.testing.assert_allclose(found.coherence, 1.0, atol=1e-10)


def test_a_multisine_has_only_its_frequencies_and_a_low_crest_factor() -> None:
    lines = f.log_harmonics(2, 80, 25)
    x = f.multisine(SAMPLES, lines, (1, 0))
    spectrum = np.abs(np.fft.rfft(x))
    others = np.setdiff1d(np.arange(spectrum.size), lines)
    assert np.abs(x).max() == pytest.approx(1.0)
    assert spectrum[others].max() < 1e-9 * spectrum[lines].min()
    np.testing.assert_allclose(spectrum[lines], spectrum[lines[0]], rtol=1e-9)
    assert crest(x) < 2.7  # the crest factor of Gaussian noise of this length is about 3.5
    np.testing.assert_array_equal(x, f.multisine(SAMPLES, lines, (1, 0)))
    assert not np.allclose(x, f.multisine(SAMPLES, lines, (1, 1)))


@pytest.mark.parametrize(("lowest", "highest"), [(2, 80), (2, 81), (1, 50)])
def test_chirps_are_periodic_and_cover_their_band(lowest: int, highest: int) -> None:
    for realization in range(8):
        x = f.chirp(SAMPLES, lowest, highest, realization)
        assert np.abs(x).max() == pytest.approx(1.0, abs=1e-3)
        jump = np.abs(np.diff(np.append(x, x[0]))).max()
        assert jump < 1.1 * 2.0 * np.pi * highest / SAMPLES
        power = np.abs(np.fft.rfft(x)) ** 2
        assert power[lowest : highest + 1].sum() > 0.97 * power.sum()


def test_a_nonlinearity_lowers_the_coherence() -> None:
    command, lines = excite("multisine")
    b, a = signal.butter(1, 0.05)
    linear = estimate(command, filtered(command, b, a), lines)
    bent = estimate(command, filtered(command, b, a) ** 3, lines)
    dead = estimate(command, filtered(np.sign(command) * (np.abs(command) > 0.5), b, a), lines)
    assert linear.coherence.min() > 1.0 - 1e-9
    assert bent.best < 1.0 - 1e-3
    assert bent.frequency.size < lines.size
    assert dead.best < 1.0 - 1e-3


def test_noise_has_no_coherent_frequency() -> None:
    command, lines = excite("multisine")
    noise = np.random.default_rng(3).normal(size=command.shape)
    found = estimate(command, noise, lines)
    assert found.frequency.size == 0
    assert found.best < 0.95
    assert f.bandwidth(found) is None
    assert f.resonance(found) is None


def test_unexcited_frequencies_are_not_reported() -> None:
    command, lines = excite("multisine")
    more = np.arange(2, 121)
    found = estimate(command, command, more)
    np.testing.assert_allclose(found.frequency * PERIOD, lines, atol=1e-9)
    silent = estimate(0.0 * command, command, lines)
    assert silent.frequency.size == 0
    assert silent.excited.size == 0


def exact(frequency: np.ndarray, gain: np.ndarray) -> f.Response:
    return f.Response(
        frequency=frequency,
        magnitude=np.abs(gain),
        phase=np.unwrap(np.angle(gain)),
        coherence=np.ones_like(frequency),
        excited=frequency,
        best=1.0,
    )


def test_bandwidth_of_a_first_order_lag_is_its_corner_frequency() -> None:
    lines = np.geomspace(0.01, 30.0, 200)
    corner = 3.0
    gain = 1.0 / (1.0 + 1j * lines / corner)
    found = f.bandwidth(exact(lines, gain))
    assert found == pytest.approx(corner, rel=2e-3)
    assert f.resonance(exact(lines, gain)) is None
    assert f.bandwidth(exact(lines[lines < 2.0], gain[lines < 2.0])) is None


def test_resonance_of_a_second_order_lag_equals_the_closed_form() -> None:
    natural, zeta = 5.0, 0.2
    lines = np.geomspace(0.05, 50.0, 150)
    ratio = lines / natural
    found = f.resonance(exact(lines, 1.0 / (1.0 - ratio**2 + 2j * zeta * ratio)))
    assert found is not None
    assert found[0] == pytest.approx(natural * np.sqrt(1.0 - 2.0 * zeta**2), rel=2e-3)
    peak = 1.0 / (2.0 * zeta * np.sqrt(1.0 - zeta**2))
    assert found[1] == pytest.approx(20.0 * np.log10(peak), abs=0.02)


def test_bandwidth_is_not_interpolated_across_missing_frequencies() -> None:
    lines = np.geomspace(0.1, 30.0, 60)
    gain = 1.0 / (1.0 + 1j * lines / 3.0)
    whole = exact(lines, gain)
    corner = int(np.searchsorted(lines, 3.0))
    kept = np.delete(np.arange(lines.size), [corner - 1, corner])
    gap = f.Response(
        lines[kept], np.abs(gain[kept]), np.angle(gain[kept]), np.ones(kept.size), lines, 1.0
    )
    assert f.bandwidth(whole) is not None
    assert f.bandwidth(gap) is None
    late = f.Response(
        lines[1:], np.abs(gain[1:]), np.angle(gain[1:]), np.ones(lines.size - 1), lines, 1.0
    )
    assert f.bandwidth(late) is None


def test_an_integrator_has_no_bandwidth() -> None:
    lines = np.geomspace(0.5, 20.0, 40)
    assert f.bandwidth(exact(lines, 1.0 / (2j * np.pi * lines))) is None
