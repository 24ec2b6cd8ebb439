"""A small sample of the benchmark of ``excite --separate``."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from separating_motions import NOISE, run


def test_the_separating_motion_decides_no_fewer_cases_at_the_stated_noise() -> None:
    counts = run(pairs=2, draws=3)
    cases, usual, separating = counts[NOISE[0]]
    assert cases == 12
    assert usual <= separating
    assert separating > 0
