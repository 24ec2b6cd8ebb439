"""Goldens of kind replay: measures, dependencies and refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from replay_trials import ARM, series

from pytest_twin.checks import check_of
from pytest_twin.errors import PathError, RecordingError, SpecError, TwinError
from pytest_twin.formats.mcap import read_recording, write_recording
from pytest_twin.gate.specs import load_golden
from pytest_twin.metrics.residual import residual, rotation_angle
from pytest_twin.open_loop import Row, replay_rows
from pytest_twin.outcome import Measure
from pytest_twin.realization import load
from pytest_twin.trial import make_trial
from pytest_twin.twin import load_twin

JOINTS = ("shoulder", "elbow")
TWIN = """\
name: arm
model: arm.xml
tcp: tool
roots: {logs: ../logs}
controllers:
  soft: {shoulder: {kp: 60}}
calibration:
  id: cal1
  joints: {elbow: {offset: 0.1, sign: -1}}
"""


def run(root: Path, golden: dict[str, Any]) -> list[Measure]:
    """Write a golden, observe and compare it."""
    path = root / "golden" / "replay.yaml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(yaml.safe_dump({"schema": 1, "kind": "replay"} | golden))
    twin = load_twin(root / "twin.yaml")
    loaded = load_golden(path, twin)
    realization = load(twin.realizations["mujoco"].file, twin=twin)
    check = check_of("replay")
    observation = check.observe(loaded, realization, lambda _: None)
    assert check.expect(loaded, observation) == (observation.values, None)
    return check.compare(loaded, observation, None)


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    """A twin with recordings of its own motion plus known errors."""
    root, logs = tmp_path / "arm", tmp_path / "logs"
    root.mkdir()
    logs.mkdir()
    (root / "twin.yaml").write_text(TWIN)
    (root / "arm.xml").write_text(ARM)
    record(root, logs / "moves.mcap")
    record(root, logs / "soft.mcap", controller="soft")
    record(root, logs / "unheard_of.mcap", controller="stiff")
    return root


def record(root: Path, path: Path, controller: str | None = None) -> None:
    twin = load_twin(root / "twin.yaml")
    realization = load(root / "arm.xml", twin=twin)
    known = controller if controller in twin.controllers else None
    time = np.arange(0, 2.0, 0.01)
    command = np.column_stack([0.4 * np.sin(3 * time), 0.3 - 0.2 * np.sin(5 * time)])
    # Both joints start away from their commands, so that an ignored encoder zero shows.
    position = np.tile([0.05, 0.25], (len(time), 1))
    sent = series("/joint_commands", JOINTS, time, position=command)
    metadata = {} if controller is None else {"controller": controller}
    state = series("/joint_states", JOINTS, time, position=position)
    write_recording(path, [state, sent], metadata)
    trial = make_trial(read_recording(path))
    (result,) = replay_rows(
        [Row(trial, realization.variant(known).model, twin.calibration.joints)]  # type: ignore[union-attr]
    )
    measured = result.position.copy()
    # 0.03 rad at the elbow from 1 s on; a spike of 0.2 rad at the shoulder at 1.5 s.
    measured[100:, 1] += 0.03
    measured[150, 0] -= 0.2
    state = series(
        "/joint_states", JOINTS, time, position=measured, velocity=result.velocity + 0.01
    )
    write_recording(path, [state, sent], metadata)


def test_measures_equal_the_injected_errors(arm: Path) -> None:
    measures = run(
        arm,
        {
            "target": {"recording": "moves.mcap"},
            "tolerance": {
                "angle_rms": "0.02 rad",
                "angle_max": "0.1 rad",
                "angular_velocity_rms": "0.02 rad/s",
            },
        },
    )
    found = {(m.name, m.subject): m for m in measures}
    assert set(found) == {
        (name, joint)
        for name in ("angle_rms", "angle_max", "angular_velocity_rms")
        for joint in JOINTS
    }
    elbow, spike = found["angle_rms", "elbow"], found["angle_max", "shoulder"]
    assert elbow.error == pytest.approx(0.03 * np.sqrt(0.5), rel=1e-6)
    assert (elbow.passed, elbow.against, elbow.unit) == (False, "recording", "rad")
    assert spike.error == pytest.approx(0.2, rel=1e-6)
    assert spike.time == pytest.approx(1.5)
    assert spike.measured - spike.golden == pytest.approx(0.2, rel=1e-6)
    assert not spike.passed
    assert found["angle_rms", "shoulder"].error == pytest.approx(0.2 / np.sqrt(200), rel=1e-6)
    assert found["angular_velocity_rms", "elbow"].error == pytest.approx(0.01, rel=5e-3)


def test_a_joint_may_have_its_own_tolerances(arm: Path) -> None:
    measures = run(
        arm,
        {
            "target": {
                "recording": "moves.mcap",
                "joints": {"elbow": {"angle_rms": "2 deg"}, "shoulder": None},
            },
            "tolerance": {"angle_rms": "0.02 rad"},
        },
    )
    assert {m.subject: m.tolerance for m in measures} == pytest.approx(
        {"elbow": np.deg2rad(2), "shoulder": 0.02}
    )
    assert all(m.passed for m in measures)


def test_tcp_error_compares_forward_kinematics_of_predicted_and_measured_joints(arm: Path) -> None:
    measures = run(
        arm,
        {
            "target": {"recording": "moves.mcap", "joints": ["elbow"], "tcp": "tool"},
            "tolerance": {
                "angle_max": "0.1 rad",
                "tcp_position_max": "40 mm",
                "tcp_position_rms": "40 mm",
                "tcp_orientation_max": "0.1 rad",
            },
        },
    )
    found = {m.name: m for m in measures}
    # Both joint axes are parallel: the orientation error is the sum of the joint errors.
    assert found["tcp_orientation_max"].error == pytest.approx(0.2 + 0.03, abs=1e-6)
    # Upper bound: 0.2 rad times 0.55 m plus 0.03 rad times 0.25 m.
    assert 0.05 < found["tcp_position_max"].error < 0.2 * 0.55 + 0.03 * 0.25
    assert found["tcp_position_max"].time == pytest.approx(1.5)
    assert found["tcp_position_rms"].error < found["tcp_position_max"].error


def test_the_gains_of_the_recorded_controller_are_applied(arm: Path) -> None:
    golden: dict[str, Any] = {
        "target": {"recording": "soft.mcap", "controller": "soft"},
        "tolerance": {"angular_velocity_rms": "0.02 rad/s"},
    }
    assert all(m.passed for m in run(arm, golden))
    # With the model's own gains the velocity error exceeds the tolerance.
    text = (arm / "twin.yaml").read_text()
    (arm / "twin.yaml").write_text(text.replace("kp: 60", "kp: 200"))
    assert not all(m.passed for m in run(arm, golden))


def test_a_replay_golden_depends_on_all_dynamics_and_its_recording(arm: Path) -> None:
    path = arm / "golden" / "replay.yaml"
    path.parent.mkdir()
    path.write_text(
        "schema: 1\nkind: replay\ntolerance: {angle_rms: 1 deg}\n"
        "target: {recording: soft.mcap, controller: soft, joints: [elbow], tcp: tool}\n"
    )
    twin = load_twin(arm / "twin.yaml")
    structure = load(arm / "arm.xml", twin=twin).structure
    parts = set(check_of("replay").depends(load_golden(path, twin), structure))
    assert {
        "recording:soft.mcap", "controller:soft", "calibration:elbow", "calibration:shoulder",
        "mujoco/frame:tool", "mujoco/actuator:shoulder", "mujoco/option:gravity",
    } <= parts  # fmt: skip
    assert parts >= set(structure.dynamics())


REFUSALS: dict[str, tuple[dict[str, Any], type[TwinError], str]] = {
    "no such file": (
        {"target": {"recording": "none.mcap"}, "tolerance": {"angle_rms": "1 deg"}},
        PathError,
        "target.recording: no such file (got 'none.mcap'; expected a file or folder below ",
    ),
    "outside": (
        {"target": {"recording": "../../moves.mcap"}, "tolerance": {"angle_rms": "1 deg"}},
        PathError,
        "target.recording: no such file (got '../../moves.mcap'",
    ),
    "joint": (
        {
            "target": {"recording": "moves.mcap", "joints": ["elbo"]},
            "tolerance": {"angle_rms": "1 deg"},
        },
        SpecError,
        "target.joints.0: no recorded joint of this name (got 'elbo'; expected did you mean "
        "'elbow'?)",
    ),
    "no bound": (
        {"target": {"recording": "moves.mcap"}, "tolerance": {"position_rms": "1 mm"}},
        SpecError,
        "tolerance: no tolerance bounds the replay (expected angle_rms, ",
    ),
    "no bound of one joint": (
        {
            "target": {
                "recording": "moves.mcap",
                "joints": {"elbow": {"angle_rms": "1 deg"}, "shoulder": None},
            },
        },
        SpecError,
        "tolerance: no tolerance bounds joint 'shoulder' (expected angle_rms or angle_max or "
        "angular_velocity_rms or torque_rms or magnitude or phase or "
        "bandwidth or resonance or effort_magnitude or effort_phase)",
    ),
    "controller not stated": (
        {"target": {"recording": "soft.mcap"}, "tolerance": {"angle_rms": "1 deg"}},
        SpecError,
        "target.controller: not the controller that soft.mcap was recorded with (got 'none'; "
        "expected controller: soft)",
    ),
    "controller not declared": (
        {
            "target": {"recording": "unheard_of.mcap", "controller": "stiff"},
            "tolerance": {"angle_rms": "1 deg"},
        },
        SpecError,
        "target.controller: twin.yaml declares no such controller (got 'stiff'; expected soft)",
    ),
    "frame": (
        {
            "target": {"recording": "moves.mcap", "tcp": "tol"},
            "tolerance": {"tcp_position_max": "1 mm"},
        },
        SpecError,
        "the model has no frame 'tol'",
    ),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_an_invalid_replay_golden_is_refused_with_the_reason(name: str, arm: Path) -> None:
    golden, kind, words = REFUSALS[name]
    with pytest.raises(kind) as refusal:
        run(arm, golden)
    assert words in str(refusal.value)


def test_a_recording_of_another_robot_is_refused(arm: Path) -> None:
    time = np.arange(0, 1.0, 0.01)
    states = series("/joint_states", ("wheel",), time, position=time)
    write_recording(
        arm / "rover.mcap", [states, series("/joint_commands", ("wheel",), time, position=time)]
    )
    with pytest.raises(RecordingError, match=r"the model has no such joint \(got 'wheel'"):
        run(arm, {"target": {"recording": "rover.mcap"}, "tolerance": {"angle_rms": "1 deg"}})


@pytest.mark.parametrize(
    ("error", "expected"),
    [([0.0, 0.0], (0.0, 0.0, 0.0, 0)), ([3.0, -4.0], (np.sqrt(12.5), 4.0, -0.5, 1))],
)
def test_residual_returns_rms_maximum_mean_and_worst_sample(
    error: list[float], expected: tuple[float, float, float, int]
) -> None:
    measured = np.array([1.0, 2.0])
    found = residual(measured + np.array(error), measured)
    assert (found.rms, found.maximum, found.mean, found.maximum_at) == pytest.approx(expected)


def test_a_residual_with_nan_has_nan_statistics() -> None:
    found = residual(np.array([0.0, np.nan, 0.0]), np.zeros(3))
    assert np.isnan(found.rms)
    assert np.isnan(found.maximum)
    assert found.maximum_at == 1


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, np.pi - 1e-6, np.pi])
def test_rotation_angle_is_exact_from_0_to_pi(angle: float) -> None:
    q = np.array([[np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0]])
    identity = np.array([[1.0, 0.0, 0.0, 0.0]])
    assert rotation_angle(q, identity)[0] == pytest.approx(angle, rel=1e-9, abs=1e-15)
    assert rotation_angle(-q, identity)[0] == pytest.approx(angle, rel=1e-9, abs=1e-15)
