"""Command ``pytest-twin excite --separate``: the motion that tells two hypotheses apart."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from approved_arms import ARM, approved_for_arm, write_twin

from pytest_twin import cli
from pytest_twin.errors import SpecError
from pytest_twin.excitation.hypotheses import read_diagnosed, read_rivals
from pytest_twin.excitation.separate import separate_file
from pytest_twin.formats.schema import load_schema

JOINTS = ("lift", "elbow")
WITHOUT_SERVOS = ARM.split("<actuator>")[0] + "</mujoco>"


def separated(folder: Path, words: str, model: str = ARM, **changes: Any) -> dict[str, Any]:
    """The document of one separation, with position noise of 0.3 mrad on the arm with servos."""
    section = approved_for_arm()
    for joint in section["joints"].values():
        joint |= {"position_noise": 3e-4}
        if model == ARM:
            del joint["effort_noise"]
    twin = write_twin(folder, {**section, **changes}, model)
    (folder / "out").mkdir()
    diagnosis = folder / "diagnosis" if (folder / "diagnosis").is_dir() else None
    return dict(
        separate_file(
            str(twin), str(folder / "out"), words, None if diagnosis is None else str(diagnosis), 1
        )["document"]
    )


def refusal(words: str, **changes: Any) -> str:
    with pytest.raises(SpecError) as caught:
        read_rivals(
            words, JOINTS, changes.get("modes", ("position", "position")), changes.get("diagnosed")
        )
    return str(caught.value)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("backlash@elbow", "not two effects"),
        ("backlash@elbow,", "not two effects"),
        ("backlash@elbow,backlash@elbow", "twice the same effect"),
        ("backlsh@elbow,dead_zone@elbow", "no effect of the catalogue"),
        ("backlash@elbw,dead_zone@elbow", "no joint that may move"),
        ("backlash,dead_zone@elbow", "expected backlash@lift or backlash@elbow"),
        ("base_tilt@elbow,dead_zone@elbow", "this effect is the whole robot's"),
        ("contact_friction,dead_zone@elbow", "touches nothing"),
        ("unnamed_friction@elbow,dead_zone@elbow", "no effect of the catalogue"),
    ],
)
def test_hypotheses_that_no_motion_can_separate_are_refused_in_one_line(
    words: str, expected: str
) -> None:
    text = refusal(words)
    assert expected in text
    assert "--separate" in text
    assert "\n" not in text


def test_a_law_of_position_servos_is_refused_at_a_joint_with_a_velocity_servo() -> None:
    text = refusal("velocity_feedforward@elbow,dead_zone@elbow", modes=("velocity", "velocity"))
    assert "cannot act under velocity commands" in text


def test_the_same_law_at_two_joints_is_two_hypotheses() -> None:
    first, second = read_rivals("backlash@lift,backlash@elbow", JOINTS, None, None)
    assert (first.term.joint, second.term.joint) == (0, 1)


def test_efforts_of_a_robot_without_servos_separate_dry_from_viscous_friction(
    tmp_path: Path,
) -> None:
    document = separated(tmp_path, "coulomb_friction@elbow,viscous_friction@elbow", WITHOUT_SERVOS)
    jsonschema.validate(document, load_schema("results/excite.schema.json"))
    separation = document["separation"]
    assert document["verdict"] == "separable"
    assert separation["signals"] == "efforts"
    best, usual = separation["expected"][0], separation["usual_motion"]
    assert best["probability"] >= 0.9
    assert best["log_odds"] >= usual["log_odds"]
    fit, held_out = document["trajectories"]
    assert (fit["role"], held_out["role"]) == ("fit", "held_out")
    assert fit["name"] == best["trajectory"]
    for one in document["trajectories"]:
        assert all((tmp_path / "out" / name).is_file() for name in one["files"])
        assert all(margin["share"] <= 1.0 + 1e-9 for margin in one["margins"].values())


def test_efforts_of_a_followed_motion_do_not_show_a_delay(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="do not show this") as caught:
        separated(tmp_path, "command_delay@elbow,viscous_friction@elbow", WITHOUT_SERVOS)
    assert "a model with a position or velocity servo" in str(caught.value)


@pytest.mark.nightly
def test_the_motion_of_servos_separates_a_delay_of_one_command_from_that_of_all_readings(
    tmp_path: Path,
) -> None:
    document = separated(tmp_path, "command_delay@elbow,sensor_delay", duration=5.0)
    assert document["verdict"] == "separable"
    assert document["separation"]["signals"] == "positions"
    # A delay of the elbow's command and of all readings differ in the motion of the lift alone.
    assert "lift" in document["trajectories"][0]["moved"]


def test_noise_beyond_both_effects_makes_them_inseparable(tmp_path: Path) -> None:
    section = approved_for_arm()["joints"]
    joints = {name: {**one, "effort_noise": 1e3} for name, one in section.items()}
    document = separated(
        tmp_path, "coulomb_friction@elbow,viscous_friction@elbow", WITHOUT_SERVOS, joints=joints
    )
    assert document["verdict"] == "not_separable"
    assert document["separation"]["expected"][0]["probability"] < 0.9


def test_parameters_noise_and_joints_come_from_the_diagnosis(tmp_path: Path) -> None:
    finding = {
        "effect": "coulomb_friction",
        "joint": "elbow",
        "confidence": 0.6,
        "parameters": {"coulomb": {"value": 0.31, "unit": "N*m", "ci95": [0.3, 0.32]}},
        "alternatives": [{"effect": "viscous_friction", "confidence": 0.3}],
    }
    (tmp_path / "diagnosis").mkdir()
    (tmp_path / "diagnosis" / "diagnosis.json").write_text(
        json.dumps({
            "schema": 1, "findings": [finding], "held_out": {},
            "effort": {"elbow": {"rms_usual": 0.08, "rms_after": 0.11, "unit": "N*m"}},
        })
    )  # fmt: skip
    document = separated(tmp_path, "coulomb_friction,viscous_friction", WITHOUT_SERVOS)
    first, second = document["separation"]["hypotheses"]
    assert (first["name"], second["name"]) == ("coulomb_friction@elbow", "viscous_friction@elbow")
    assert first["parameters"]["coulomb"]["value"] == pytest.approx(0.31)
    assert (first["source"], second["source"]) == ("diagnosis", "typical size")
    assert document["separation"]["noise"]["elbow"]["effort"]["value"] == pytest.approx(0.11)


@pytest.mark.parametrize("text", ["", "[]", '{"findings": [{}]}', '{"findings": 3}'])
def test_a_folder_without_a_readable_diagnosis_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "diagnosis.json").write_text(text)
    with pytest.raises(Exception, match="not a diagnosis") as caught:
        read_diagnosed(tmp_path)
    assert "--diagnosis" in str(caught.value)


def test_limits_are_never_invented(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "twin.yaml").write_text("model: arm.xml\n")
    words = ["--separate", "backlash@elbow,dead_zone@elbow", "--out", str(tmp_path / "out")]
    assert cli.main(["excite", str(tmp_path / "twin.yaml"), *words]) == 2
    out, error = capsys.readouterr()
    assert "excitation:" in out
    assert "approved_by" in error
    assert not (tmp_path / "out" / "excitation.json").exists()


def test_the_command_writes_the_motion_and_states_the_odds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = write_twin(tmp_path, approved_for_arm(), WITHOUT_SERVOS)
    out = tmp_path / "out"
    words = ["--separate", "coulomb_friction@elbow,viscous_friction@elbow", "--out", str(out)]
    assert cli.main(["excite", str(twin), *words, "--json", "-"]) == 0
    stdout, said = capsys.readouterr()
    document = json.loads(stdout)
    assert document == json.loads((out / "excitation.json").read_text())
    assert "Separable: coulomb_friction@elbow and viscous_friction@elbow" in said
    assert "expected probability of the true one" in said
    html = (out / "excitation.html").read_text()
    assert "viscous_friction@elbow" in html
    assert (out / "abort.json").is_file()
    assert np.isfinite(document["separation"]["expected"][0]["log_odds"])
