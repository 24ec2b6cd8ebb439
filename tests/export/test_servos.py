"""The library of identified servos, and ``pytest-twin servo``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from exported import Effect, diagnosis_in, robot_in

from pytest_twin.cli import main
from pytest_twin.servos import library

pytestmark = pytest.mark.usefixtures("commands_in_process")
ARM = """
<robot name="arm">
<link name="base"/><link name="arm"><inertial><origin xyz="0 0 0.1"/><mass value="0.3"/>
<inertia ixx="0.001" iyy="0.001" izz="0.0005" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="arm"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="3" velocity="5"/></joint>
</robot>
"""
GAIN: list[Effect] = [("controller_gain", 1, {"stiffness_error": 0.3, "damping_error": -0.2})]


@pytest.fixture
def own_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "own" / "servos.yaml"
    monkeypatch.setenv(library.VARIABLE, str(path))
    return path


def test_every_entry_has_evidence_conditions_and_units() -> None:
    for servo in library.servos().values():
        assert set(servo.evidence) == {"recordings", "digest", "command", "version"}
        assert servo.conditions
        assert servo.drive
        assert all(estimate.how for estimate in servo.drive.values())


def test_init_writes_the_drives_of_a_servo(tmp_path: Path) -> None:
    robot = tmp_path / "arm.urdf"
    robot.write_text(ARM)
    out = tmp_path / "twin"
    assert main(["init", str(robot), "--servo", "sts3215", "--out", str(out)]) == 0
    fit = yaml.safe_load((out / "twin.yaml").read_text())["fit"]
    assert fit["id"] == "servo-sts3215"
    (actuator,) = fit["actuator"].values()
    assert actuator["kp"] == library.find("sts3215").drive["stiffness"].value
    assert fit["joint"]["shoulder"]["frictionloss"] == pytest.approx(0.39)


def test_an_unknown_servo_is_refused_with_the_known_ones(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = tmp_path / "arm.urdf"
    robot.write_text(ARM)
    assert main(["init", str(robot), "--servo", "mx28", "--out", str(tmp_path / "twin")]) == 2
    assert "no such servo" in capsys.readouterr().err


def test_a_diagnosed_joint_becomes_a_servo_of_the_users_library(
    tmp_path: Path, own_library: Path
) -> None:
    diagnosis = diagnosis_in(tmp_path, robot_in(tmp_path, seconds=1.0), GAIN)
    arguments = ["servo", "add", str(diagnosis), "--id", "mine", "--joint", "right"]
    assert main([*arguments, "--condition", "supply=12 V"]) == 0
    servo = library.find("mine")
    assert servo.drive["stiffness"].value == pytest.approx(7.8)
    assert servo.drive["stiffness"].how == "finding controller_gain"
    assert servo.drive["armature"].how == "the diagnosed model, not changed by a finding"
    assert servo.conditions["supply"] == "12 V"
    assert main(["servo", "show", "mine"]) == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("schema: 2\nservos: []\n", "not a library of servos"),
        ("schema: 1\nservos:\n- {id: a}\n", "wrong field of a servo"),
    ],
)
def test_a_library_with_wrong_fields_is_refused_in_one_line(
    own_library: Path, capsys: pytest.CaptureFixture[str], text: str, message: str
) -> None:
    own_library.parent.mkdir()
    own_library.write_text(text)
    assert main(["servo", "list"]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_parameter_in_another_unit_is_refused(
    own_library: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = library.library_text({"a": library.find("sts3215")})
    own_library.parent.mkdir()
    own_library.write_text(text.replace("unit: N*m/rad", "unit: N*mm/deg"))
    assert main(["servo", "list"]) == 2
    assert "wrong parameter of a servo" in capsys.readouterr().err


def test_the_list_as_json_has_all_fields(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["servo", "list", "--json", "-"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert {"id", "law", "drive", "evidence"} <= set(document["servos"][0])
