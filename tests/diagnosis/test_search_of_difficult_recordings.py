"""Recordings of stick-slip motion, and of commands between whose stamps the setpoint moves."""

from __future__ import annotations

from pathlib import Path

import pytest
from recorded_pendulum import Reality, cell
from two_pendulums import mjcf, record

from pytest_twin.diagnosis.diagnose import Diagnosis, diagnose
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.loaded_model import load_model


def diagnosed(model: Path, recordings: list[Path]) -> Diagnosis:
    loaded = load_model(model)
    trials = read_trials(recordings, [], loaded.topics, loaded.realization.structure)
    return diagnose(loaded.realization, trials, threads=1)


def test_dry_friction_is_found_in_stick_slip_motion(tmp_path: Path) -> None:
    (tmp_path / "model.xml").write_text(mjcf(("left",)))
    recordings = [
        record(tmp_path / f"{seed}.mcap", seed, joints=("left",), role=role, seconds=2.2, dry=0.6)
        for seed, role in ((1, "fit"), (2, "fit"), (3, "held_out"))
    ]
    found = diagnosed(tmp_path / "model.xml", recordings)
    (finding,) = found.explanation.findings
    assert finding.effect == "coulomb_friction"
    estimate = finding.parameters["coulomb"]
    assert estimate.low <= 0.6 <= estimate.high
    assert estimate.high - estimate.low < 0.1
    assert found.verdict == "explained"


@pytest.mark.nightly
def test_a_lag_is_found_where_setpoints_move_between_commands(tmp_path: Path) -> None:
    """Held setpoints with half a period less delay would explain nearly as much."""
    found = diagnosed(*cell(tmp_path, Reality(between="interpolated", lag=0.012), seeds=(1, 2, 3)))
    (finding,) = found.explanation.findings
    assert finding.effect == "actuator_lag"
    estimate = finding.parameters["time_constant"]
    assert estimate.low <= 0.012 <= estimate.high
    assert found.verdict == "explained"
