"""Replay tolerances on effort and frequency response."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from replay_trials import ARM, series
from test_replay_check import JOINTS, TWIN, run

from pytest_twin import cli
from pytest_twin.errors import SpecError
from pytest_twin.formats.mcap import read_recording, write_recording
from pytest_twin.formats.schema import load_schema
from pytest_twin.realization import load
from pytest_twin.replay import Row, replay_rows
from pytest_twin.trial import make_trial
from pytest_twin.twin import load_twin


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    """A twin and a recording of its motion with elbow amplitude +30 % and elbow effort +2 N*m."""
    root, logs = tmp_path / "arm", tmp_path / "logs"
    root.mkdir()
    logs.mkdir()
    (root / "twin.yaml").write_text(TWIN)
    (root / "arm.xml").write_text(ARM)
    twin = load_twin(root / "twin.yaml")
    realization = load(root / "arm.xml", twin=twin)
    time = np.arange(0, 20.0, 0.01)
    random = np.random.default_rng(0)
    command = np.cumsum(random.standard_normal((len(time), 2)), axis=0) * 0.01
    sent = series("/joint_commands", JOINTS, time, position=command)
    still = np.tile(command[0], (len(time), 1))
    path = logs / "moves.mcap"
    write_recording(path, [series("/joint_states", JOINTS, time, position=still), sent], {})
    trial = make_trial(read_recording(path))
    (result,) = replay_rows([Row(trial, realization.model, twin.calibration.joints)])  # type: ignore[union-attr]
    measured = result.position.copy()
    measured[:, 1] = measured[0, 1] + 1.3 * (measured[:, 1] - measured[0, 1])
    effort = result.effort + np.array([0.0, 2.0])
    state = series("/joint_states", JOINTS, time, position=measured, effort=effort)
    write_recording(path, [state, sent], {})
    return root


def test_magnitude_tolerance_detects_30_percent_more_amplitude(arm: Path) -> None:
    golden = {
        "target": {"recording": "moves.mcap"},
        "tolerance": {"magnitude": "1 dB", "phase": "0.1 rad"},
    }
    found = {(m.name, m.subject.partition(",")[0]): m for m in run(arm, golden)}
    elbow = found["magnitude", "elbow"]
    assert elbow.error == pytest.approx(20 * np.log10(1.3), abs=0.3)
    assert not elbow.passed
    assert elbow.unit == "dB"
    assert "Hz, worst at" in elbow.subject
    assert found["magnitude", "shoulder"].passed
    assert found["phase", "shoulder"].passed


def test_torque_tolerance_detects_a_constant_effort_error(arm: Path) -> None:
    golden = {"target": {"recording": "moves.mcap"}, "tolerance": {"torque_rms": "0.5 N*m"}}
    found = {m.subject: m for m in run(arm, golden)}
    assert found["elbow"].error == pytest.approx(2.0, rel=1e-3)
    assert found["shoulder"].passed


def test_a_recording_without_excitation_or_effort_is_refused(arm: Path) -> None:
    path = arm.parent / "logs" / "moves.mcap"
    time = np.arange(0, 1.0, 0.01)
    still = np.tile([0.1, 0.2], (len(time), 1))
    sent = series("/joint_commands", JOINTS, time, position=still)
    moved = still + 0.01 * np.sin(time)[:, None]
    write_recording(path, [series("/joint_states", JOINTS, time, position=moved), sent], {})
    for tolerance, words in (
        ({"phase": "0.1 rad"}, "tolerance.phase: no frequency of 'shoulder' is supported"),
        ({"torque_rms": "1 N*m"}, "tolerance.torque_rms: the recording has no effort of"),
    ):
        with pytest.raises(SpecError) as error:
            run(arm, {"target": {"recording": "moves.mcap"}, "tolerance": tolerance})
        assert words in str(error.value)


def test_the_replay_report_shows_the_frequency_response_of_each_joint(arm: Path) -> None:
    out = arm.parent / "predicted.mcap"
    moves = arm.parent / "logs" / "moves.mcap"
    assert cli.main(["replay", str(arm / "twin.yaml"), str(moves), "--out", str(out)]) == 0
    summary = json.loads(out.with_suffix(".json").read_text())
    jsonschema.validate(summary, load_schema("results/replay.schema.json"))
    (elbow,) = (
        one for one in summary["frequency_response"]
        if (one["joint"], one["input"]) == ("elbow", "command")
    )  # fmt: skip
    ratio = np.array(elbow["measured"]["magnitude_db"]) - np.array(
        elbow["predicted"]["magnitude_db"]
    )
    np.testing.assert_allclose(ratio, 20 * np.log10(1.3), atol=1e-3)
    page = out.with_suffix(".html").read_text()
    assert "Frequency response" in page
    assert page.count("magnitude, phase and coherence over frequency") >= 2
