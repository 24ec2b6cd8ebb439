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
from pytest_twin.open_loop import Row, replay_rows
from pytest_twin.realization import load
from pytest_twin.trial import make_trial
from pytest_twin.twin import load_twin

pytestmark = pytest.mark.usefixtures("commands_in_process")


def recorded(root: Path, gain: float, effort: float, real: str = ARM) -> Path:
    """Write a twin and a recording of a real arm under a random walk of commands.

    Args:
        root: new folder of the twin; the recording is in ``logs`` beside it.
        gain: factor on the elbow's amplitude.
        effort: constant added to the elbow's effort, N*m.
        real: model of the real arm; the twin has ``ARM``.
    """
    logs = root.parent / "logs"
    root.mkdir()
    logs.mkdir()
    (root / "twin.yaml").write_text(TWIN)
    (root / "arm.xml").write_text(real)
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
    measured[:, 1] = measured[0, 1] + gain * (measured[:, 1] - measured[0, 1])
    efforts = result.effort + np.array([0.0, effort])
    state = series("/joint_states", JOINTS, time, position=measured, effort=efforts)
    write_recording(path, [state, sent], {})
    (root / "arm.xml").write_text(ARM)
    return root


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    """A twin and a recording of its motion with elbow amplitude +30 % and elbow effort +2 N*m."""
    return recorded(tmp_path / "arm", 1.3, 2.0)


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


def test_bandwidth_tolerance_detects_a_softer_servo(tmp_path: Path) -> None:
    soft = ARM.replace('joint="elbow" kp="80"', 'joint="elbow" kp="50"')
    root = recorded(tmp_path / "arm", 1.0, 0.0, soft)
    golden = {"target": {"recording": "moves.mcap"}, "tolerance": {"bandwidth": "0.3 Hz"}}
    found = {m.subject.partition(",")[0]: m for m in run(root, golden)}
    assert not found["elbow"].passed
    # An overdamped servo: its bandwidth is nearly proportional to its stiffness.
    assert found["elbow"].golden / found["elbow"].measured == pytest.approx(50 / 80, abs=0.08)
    assert found["elbow"].error == found["elbow"].measured - found["elbow"].golden
    assert found["elbow"].unit == "Hz"
    assert found["shoulder"].passed


def test_tolerances_on_the_response_from_effort_ignore_the_controller(tmp_path: Path) -> None:
    heavy = ARM.replace('size="0.02" mass="0.5"', 'size="0.02" mass="0.8"')
    tolerance = {"effort_magnitude": "2 dB", "effort_phase": "0.6 rad"}
    golden = {"target": {"recording": "moves.mcap"}, "tolerance": tolerance}
    soft = ARM.replace('joint="elbow" kp="80"', 'joint="elbow" kp="50"')
    for name, real, passed in (("soft", soft, True), ("heavy", heavy, False)):
        folder = tmp_path / name
        folder.mkdir()
        found = run(recorded(folder / "arm", 1.0, 0.0, real), golden)
        by_name = {(m.name, m.subject.partition(",")[0]): m for m in found}
        assert by_name["effort_magnitude", "elbow"].passed == passed, by_name


def test_a_response_without_a_resonance_is_refused(arm: Path) -> None:
    golden = {"target": {"recording": "moves.mcap"}, "tolerance": {"resonance": "1 Hz"}}
    with pytest.raises(SpecError) as error:
        run(arm, golden)
    assert "recording and model do not both show a resonance of" in str(error.value)


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
