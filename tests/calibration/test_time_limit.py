"""A calibration ends at its limit of processor time or at an interrupt, with its best values."""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent / "images"))
from test_calibrate_images import write_cell

from pytest_twin import cli, time_limit
from pytest_twin.calibration.calibrate import calibrate_file

pytestmark = pytest.mark.usefixtures("commands_in_process")


@pytest.mark.parametrize(("checks", "unread"), [(5, 3), (40, 0)])
def test_at_the_limit_of_processor_time_the_best_values_are_written_and_not_accepted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, checks: int, unread: int
) -> None:
    truth = write_cell(tmp_path, count=8)
    # Each check of the limit takes one second.
    monkeypatch.setattr(time_limit, "processor_seconds", itertools.count(1).__next__)
    monkeypatch.setattr(time_limit, "call_began", lambda: 0)
    out = ["--out", str(tmp_path / "out"), "--seconds", str(checks)]
    assert cli.main(["calibrate", str(tmp_path / "plan.yaml"), *out]) == 1
    found = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert f"its {checks} processor seconds were over" in found["reasons"][0]
    assert sum("not read" in one["why"] for one in found["excluded"]) == unread
    if not unread:
        xyz = found["records"]["hand_eye"]["transform"]["xyz"]
        np.testing.assert_allclose(xyz, truth[:3, 3], atol=5e-3)


def test_a_stop_request_ends_a_calibration_with_its_best_values(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = write_cell(tmp_path, count=10)
    fractions: list[float] = []

    def progress(fraction: float) -> None:
        if not fractions or fractions[-1] < 0.5 <= fraction:
            fractions.append(fraction)
            if fraction >= 0.5:
                monkeypatch.setattr(time_limit, "is_stop_requested", lambda: True)
        fractions.append(fraction)

    found = calibrate_file(str(tmp_path / "plan.yaml"), progress)
    assert found["verdict"] == "rejected"
    assert "because it was stopped. These are the best values so far" in found["reasons"][0]
    xyz = found["records"]["hand_eye"]["transform"]["xyz"]
    np.testing.assert_allclose(xyz, truth[:3, 3], atol=5e-3)
    # Each image moves the progress.
    assert len({one for one in fractions if one < 0.5}) >= 10
    assert fractions == sorted(fractions)


@pytest.mark.parametrize("seconds", ["-1", "soon"])
def test_a_limit_that_is_no_time_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], seconds: str
) -> None:
    with pytest.raises(SystemExit) as caught:
        cli.main(["calibrate", "plan.yaml", "--out", str(tmp_path), "--seconds", seconds])
    assert caught.value.code == 2
    assert "expected processor seconds" in capsys.readouterr().err
