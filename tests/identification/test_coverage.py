"""Short form of benchmarks/identification/coverage_of_intervals.py."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARK = Path(__file__).resolve().parents[2] / "benchmarks" / "identification"


def test_intervals_contain_the_true_parameters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARK))
    import coverage_of_intervals as coverage

    inside: list[bool] = []
    for seed in range(3):
        result, true = coverage.identified(seed, tmp_path, coverage.EncoderErrors())
        inside += coverage.covered(result, true).tolist()
        assert result.physical.is_consistent
        assert max(error.relative for error in result.errors.values()) < 0.08
    assert len(inside) > 40
    assert np.mean(inside) >= 0.85
    sys.modules.pop("coverage_of_intervals", None)


def test_intervals_allow_for_errors_of_encoders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARK))
    import coverage_of_intervals as coverage

    errors = coverage.EncoderErrors(bias=np.array([0.06, 0.0, 0.0]))
    result, true = coverage.identified(0, tmp_path, errors)
    assert [one.joint for one in result.encoders.corrected] == ["shoulder"]
    assert np.mean(coverage.covered(result, true)) >= 0.8
    for one in result.encoders.readings:
        assert abs(one.value - errors.true_of(one.joint, one.kind)) <= 1.3 * one.half_width
    sys.modules.pop("coverage_of_intervals", None)


def test_drive_gains_from_a_payload_lie_in_their_intervals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARK))
    import coverage_of_gains as coverage

    result, true, gains = coverage.identified(2, tmp_path)
    for joint, gain in zip(coverage.JOINTS, gains, strict=True):
        found = result.gains[joint]
        assert abs(found.value - gain) <= 1.5 * found.half_width
        assert found.half_width < 0.05 * gain
    assert np.mean(coverage.covered(result, true)) >= 0.8
    for name in ("coverage_of_gains", "coverage_of_intervals"):
        sys.modules.pop(name, None)
