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


def test_show_counts_the_setpoints_of_trajectories(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["show", str(INPUTS / "arm.xml"), str(INPUTS / "linear.mcap")]) == 0
    assert "setpoints of trajectories of 2 joints" in capsys.readouterr().out


def test_converted_trajectories_replay_alike(tmp_path: Path) -> None:
    converted = tmp_path / "converted.mcap"
    assert cli.main(["convert", str(INPUTS / "cubic.mcap"), "--out", str(converted)]) == 0
    rms = []
    for number, file in enumerate((INPUTS / "cubic.mcap", converted)):
        out = tmp_path / f"{number}.mcap"
        assert cli.main(["replay", str(INPUTS / "arm.xml"), str(file), "--out", str(out)]) == 0
        rms.append(json.loads(out.with_suffix(".json").read_text())["joints"]["j1"]["rms"])
    assert rms[1] == pytest.approx(rms[0], rel=1e-6)
