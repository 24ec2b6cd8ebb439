"""``pytest-twin export --to mujoco``: MuJoCo alone moves as the diagnosed model does."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mujoco
import pytest
from exported import Effect, Robot, diagnosis_in, robot_in

from pytest_twin.cli import main

pytestmark = pytest.mark.usefixtures("commands_in_process")

# The diagnosed model's error is the sensor noise alone, 1 mrad.
KEPT: list[Effect] = [
    ("coulomb_friction", 0, {"coulomb": 0.1}),
    ("asymmetric_friction", 0, {"coulomb": 0.1, "offset": 0.05}),
    ("stribeck_friction", 0, {"coulomb": 0.05, "stiction_excess": 0.1, "stribeck_velocity": 0.1}),
    ("stribeck_friction", 1, {"coulomb": 0.0, "stiction_excess": 0.1, "stribeck_velocity": 0.1}),
    ("torque_speed_limit", 0, {"inverse_no_load_speed": 0.2, "stall": 1.5}),
    ("actuator_lag", 1, {"time_constant": 0.03, "of_setpoint": 0.0}),
    ("joint_spring", 0, {"stiffness": 0.0, "preload": 0.3}),
    ("rate_limit", 0, {"inverse_rate": 1.0, "inverse_effort_rate": 0.0, "of_effort": 0.0}),
    ("integral_gain", 1, {"inverse_integral_time": 1.5}),
    ("cogging", 0, {"sine": 0.1, "cosine": 0.05, "harmonic": 12.0}),
    ("presliding_hysteresis", 0, {"coulomb": 0.1, "presliding_distance": 0.02}),
    ("backlash", 0, {"gap": 0.05, "tooth_compliance": 0.01}),
    ("joint_elasticity", 0, {"compliance": 0.05, "damping_time": 0.01}),
    ("encoder_bias", 1, {"bias": 0.05, "in_loop": 1.0}),
    ("encoder_bias", 0, {"bias": 0.05, "in_loop": 0.0}),
    ("encoder_scale", 0, {"scale_error": 0.05}),
    ("sensor_delay", -1, {"delay": 0.013}),
    ("command_delay", 1, {"delay": 0.0213}),
    ("joint_coupling", 1, {"ratio": 0.2, "form": 2.0}),
    ("joint_coupling", 1, {"ratio": 0.2, "form": 4.0}),
]
LOST: list[Effect] = [
    ("dead_zone", 0, {"width": 0.03, "of_effort": 0.0}),
    ("load_dependent_friction", 0, {"coefficient": 0.2, "of_drive": 0.0}),
]


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return robot_in(tmp_path_factory.mktemp("robot"))


def exported(diagnosis: Path, out: Path, *more: str) -> dict[str, Any]:
    held_out = str(diagnosis.parent / "held_out.mcap")
    arguments = ["export", str(diagnosis), "--to", "mujoco", "--out", str(out)]
    assert main([*arguments, "--held-out", held_out, *more]) == 0
    document: dict[str, Any] = json.loads((out / "export.json").read_text())
    return document


@pytest.mark.parametrize("effect", KEPT, ids=lambda e: f"{e[0]} {sorted(e[2].items())[-1]}")
def test_an_effect_that_mujoco_has_costs_at_most_a_twentieth_of_the_error(
    robot: Robot, tmp_path: Path, effect: Effect
) -> None:
    document = exported(diagnosis_in(tmp_path, robot, [effect]), tmp_path / "out")
    (row, _) = document["rows"]
    assert row["verdict"] == "kept", row
    assert row["difference"] <= 0.05
    mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "model.xml"))


def test_a_motor_beyond_its_no_load_speed_brakes_and_the_row_says_so(
    robot: Robot, tmp_path: Path
) -> None:
    # The pendulum moves at up to 2.57 rad/s.
    effect: Effect = ("torque_speed_limit", 0, {"inverse_no_load_speed": 0.4, "stall": 0.7})
    document = exported(diagnosis_in(tmp_path, robot, [effect]), tmp_path / "out")
    (row, _) = document["rows"]
    assert row["verdict"] == "changed"
    assert 0.05 < row["difference"] <= 0.25
    assert "above its no-load speed a dcmotor brakes by its back-EMF" in row["after"]


@pytest.mark.parametrize("effect", LOST, ids=lambda e: e[0])
def test_an_effect_that_mujoco_lacks_is_a_row_with_the_error_that_it_costs(
    robot: Robot, tmp_path: Path, effect: Effect
) -> None:
    document = exported(diagnosis_in(tmp_path, robot, [effect]), tmp_path / "out")
    (row, _) = document["rows"]
    assert row["verdict"] == "lost"
    assert row["after"]
    errors = document["held_out"]["left"]
    assert row["difference"] == pytest.approx(
        errors["rms_exported"] / errors["rms_diagnosed"] - 1.0, rel=0.02
    )


def test_several_effects_of_one_joint_share_its_drive_and_its_motor_side(
    robot: Robot, tmp_path: Path
) -> None:
    effects: list[Effect] = [
        ("backlash", 0, {"gap": 0.05, "tooth_compliance": 0.01}),
        ("rate_limit", 0, {"inverse_rate": 1.0, "inverse_effort_rate": 0.0, "of_effort": 0.0}),
        ("cogging", 0, {"sine": 0.1, "cosine": 0.05, "harmonic": 12.0}),
        ("encoder_bias", 0, {"bias": 0.05, "in_loop": 1.0}),
    ]
    document = exported(diagnosis_in(tmp_path, robot, effects), tmp_path / "out")
    assert document["held_out"]["left"]["rms_exported"] <= (
        1.1 * document["held_out"]["left"]["rms_diagnosed"]
    )


def test_an_uncertain_finding_is_named(robot: Robot, tmp_path: Path) -> None:
    doubtful = {
        "effect": "coulomb_friction",
        "joint": "right",
        "confidence": 0.55,
        "parameters": {"coulomb": {"value": 0.1, "unit": "N*m", "ci95": [-0.02, 0.2]}},
        "alternatives": [{"effect": "backlash", "joint": "right", "confidence": 0.4}],
    }
    diagnosis = diagnosis_in(tmp_path, robot, [KEPT[0]], findings=[doubtful], verdict="improved")
    notes = exported(diagnosis, tmp_path / "out")["notes"]
    assert notes == [
        "the diagnosis is 'improved': a part of the residual has no name and is not exported",
        "coulomb_friction of right is exported with a confidence of 0.55; it may be backlash "
        "instead",
        "coulomb_friction of right is exported, but its 95 % interval contains no effect at all",
    ]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"schema": 2}, "diagnosis.json: schema: another schema"),
        ({"verdict": "changed"}, "diagnosis.json: verdict: not a diagnosis with a model"),
        ({"findings": [{"effect": 7}]}, "diagnosis.json: findings: not a list of findings"),
    ],
)
def test_a_document_that_is_no_diagnosis_is_refused(
    robot: Robot,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    changed: dict[str, Any],
    message: str,
) -> None:
    diagnosis = diagnosis_in(tmp_path, robot, [KEPT[0]], **changed)
    out = tmp_path / "out"
    assert main(["export", str(diagnosis), "--to", "mujoco", "--out", str(out)]) == 2
    assert message in capsys.readouterr().err
    assert not (out / "export.json").exists()


def test_a_diagnosis_whose_files_were_edited_is_refused(
    robot: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    diagnosis = diagnosis_in(tmp_path, robot, [KEPT[0]])
    written = {"realization/model.xml": {"sha256": "0" * 64, "result": "diagnosis.json"}}
    manifest = diagnosis / ".pytest-twin.json"
    manifest.write_text(json.dumps({"schema": 1, "files": written}))
    assert main(["export", str(diagnosis), "--to", "mujoco", "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "realization/model.xml: changed since pytest-twin wrote it" in error
    assert error.count("\n") == 1


def test_without_a_recording_the_loss_is_not_measured_and_the_export_says_so(
    robot: Robot, tmp_path: Path
) -> None:
    diagnosis, out = diagnosis_in(tmp_path, robot, [KEPT[0]]), tmp_path / "out"
    assert main(["export", str(diagnosis), "--to", "mujoco", "--out", str(out)]) == 0
    document = json.loads((out / "export.json").read_text())
    assert document["checked"] == "loaded"
    assert document["notes"] == ["the loss is not measured: no held-out recording"]
