"""``JointTrajectory`` commands: the prediction follows the course that the controller commands."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pytest_twin import cli

pytestmark = pytest.mark.usefixtures("commands_in_process")
INPUTS = Path(__file__).parent / "trajectories"
NOISE = 0.0004
"""rad. Standard deviation of the recorded positions."""


@pytest.mark.parametrize("name", ["linear", "cubic", "cubic_once", "cubic_target_only", "servo"])
def test_a_trajectory_is_predicted_to_the_noise(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "predicted.mcap"
    arguments = ["replay", str(INPUTS / "arm.xml"), str(INPUTS / f"{name}.mcap")]
    assert cli.main([*arguments, "--out", str(out)]) == 0
    summary = json.loads(out.with_suffix(".json").read_text())
    assert max(joint["rms"] for joint in summary["joints"].values()) < 1.5 * NOISE
    assert summary["marks"] == []
    assert "not used: velocity" not in capsys.readouterr().out
