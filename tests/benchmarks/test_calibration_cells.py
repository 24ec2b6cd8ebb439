"""Two simulated calibration cells of each kind; the table in the documentation has a hundred."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

pytest.importorskip("cv2", reason="cells have images: pip install 'pytest-twin[calibration]'")
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "calibration"))

import blind_cells
import drawn_cells as cells


@pytest.mark.parametrize("kind", ["arm with joint zeros", "two clocks"])
def test_confidence_intervals_of_a_calibrated_cell_contain_the_truth(
    kind: str, tmp_path: Path
) -> None:
    cell = cells.make(1003, tmp_path / "cell", kind)
    found = blind_cells.score(cell, *blind_cells.solve(cell))
    assert found.status == 0
    assert len(found.inside) >= 13
    assert sum(found.inside) >= 0.75 * len(found.inside)
    assert found.held_out < cells.ACCEPT


@pytest.mark.parametrize("kind", cells.DEGENERATE)
def test_poses_without_information_give_the_verdict_degenerate(kind: str, tmp_path: Path) -> None:
    cell = cells.make(1004, tmp_path / "cell", kind)
    found = blind_cells.score(cell, *blind_cells.solve(cell))
    assert (found.status, found.verdict, found.inside) == (1, "degenerate", [])
