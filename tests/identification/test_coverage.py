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
        result, true = coverage.identified(seed, tmp_path)
        inside += coverage.covered(result, true).tolist()
        assert result.physical.consistent
        assert max(error.relative for error in result.errors.values()) < 0.08
    assert len(inside) > 40
    assert np.mean(inside) >= 0.85
    sys.modules.pop("coverage_of_intervals", None)
