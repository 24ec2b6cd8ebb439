"""The library of identified servos, and ``pytest-twin servo``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from exported import Effect, diagnosis_in, robot_in

from pytest_twin.cli import main
from pytest_twin.errors import SpecError
from pytest_twin.servos import library
from pytest_twin.servos.prior import TwinServo, priors_of
from pytest_twin.twin import load_twin

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
    written = yaml.safe_load((out / "twin.yaml").read_text())
    fit = written["fit"]
    assert fit["id"] == "servo-sts3215"
    (actuator,) = fit["actuator"].values()
    assert actuator["kp"] == library.find("sts3215").drive["stiffness"].value
    assert fit["joint"]["shoulder"]["frictionloss"] == pytest.approx(0.39)
    (servo,) = written["servos"]
    assert servo["joints"] == ["shoulder"]
    # Those whose interval is known.
    assert set(servo["parameters"]) == {"stiffness", "damping", "friction"}
    assert servo["evidence"] == library.find("sts3215").evidence["digest"]
    assert servo["conditions"]["supply"] == "unknown"
    priors = list(priors_of(load_twin(out / "twin.yaml").servos))
    assert [p.parameter for p in priors] == ["stiffness", "damping", "friction"]
    # The interval of the damping is not symmetric: its longer side counts.
    assert priors[1].deviation == pytest.approx(0.46 / 1.96, rel=1e-3)


def test_a_servo_without_known_intervals_is_no_prior(tmp_path: Path) -> None:
    robot = tmp_path / "arm.urdf"
    robot.write_text(ARM)
    out = tmp_path / "twin"
    assert main(["init", str(robot), "--servo", "xl330", "--out", str(out)]) == 0
    assert load_twin(out / "twin.yaml").servos == ()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"stiffness": {"value": 13.5, "unit": "N*mm/deg", "ci95": [12.7, 14.2]}}, "N*m/rad"),
        ({"stiffness": {"value": 15.0, "unit": "N*m/rad", "ci95": [12.7, 14.2]}}, "inside"),
        ({"stiffness": {"value": 13.5, "unit": "N*m/rad", "ci95": [13.5, 13.5]}}, "wider"),
        ({"backlash": {"value": 0.1, "unit": "rad", "ci95": [0.0, 0.2]}}, "backlash"),
    ],
    ids=["another unit", "outside its interval", "no width", "an unknown parameter"],
)
def test_a_wrong_servo_of_a_twin_is_refused(
    tmp_path: Path, changed: dict[str, object], message: str
) -> None:
    (tmp_path / "arm.urdf").write_text(ARM)
    servo = {"id": "mine", "joints": ["shoulder"], "parameters": changed}
    twin = {"schema": 1, "model": "arm.urdf", "servos": [servo]}
    (tmp_path / "twin.yaml").write_text(yaml.safe_dump(twin))
    with pytest.raises(SpecError, match=message):
        load_twin(tmp_path / "twin.yaml")


def test_a_joint_has_one_servo(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(ARM)
    servos = [
        {
            "id": name, "joints": ["shoulder"],
            "parameters": {"friction": {"value": 0.3, "unit": "N*m", "ci95": [0.2, 0.4]}},
        }
        for name in ("a", "b")
    ]  # fmt: skip
    twin = {"schema": 1, "model": "arm.urdf", "servos": servos}
    (tmp_path / "twin.yaml").write_text(yaml.safe_dump(twin))
    with pytest.raises(SpecError, match="two servos"):
        load_twin(tmp_path / "twin.yaml")


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


def test_the_interval_of_a_finding_becomes_that_of_the_servo(
    tmp_path: Path, own_library: Path
) -> None:
    diagnosis = diagnosis_in(tmp_path, robot_in(tmp_path, seconds=1.0), GAIN)
    path = diagnosis / "diagnosis.json"
    document = json.loads(path.read_text())
    document["findings"][0]["parameters"] = {
        "stiffness_error": {"value": 0.3, "unit": "1", "ci95": [0.2, 0.4]},
        "damping_error": {"value": -0.2, "unit": "1", "ci95": [-1.0, 0.6]},
    }
    path.write_text(json.dumps(document))
    assert main(["servo", "add", str(diagnosis), "--id", "mine", "--joint", "right"]) == 0
    drive = library.find("mine").drive
    # The model has 6 N*m/rad.
    assert drive["stiffness"].ci95 == pytest.approx((7.2, 8.4))
    assert drive["damping"].ci95[0] == 0.0
    assert drive["armature"].ci95 == ()
    (known,) = (p for p in priors_of([TwinServo.of(library.find("mine"), ["right"])])
                if p.parameter == "stiffness")  # fmt: skip
    assert known.deviation == pytest.approx(0.6 / 1.96, rel=1e-3)


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
