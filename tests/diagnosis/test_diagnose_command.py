"""pytest-twin diagnose, end to end, on recordings of an independent simulation."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import jsonschema
import mujoco
import numpy as np
import pytest
from two_pendulums import JOINTS, case, record

from pytest_twin import cli
from pytest_twin.diagnosis.diagnose import diagnose
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.formats.mcap import read_recording
from pytest_twin.formats.schema import load_schema
from pytest_twin.loaded_model import load_model

pytestmark = pytest.mark.usefixtures("commands_in_process")


@pytest.fixture(scope="module")
def delayed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a diagnosis of recordings with a command delay of 20 ms at one joint."""
    folder = tmp_path_factory.mktemp("delayed")
    words = case(folder, seconds=2.2, delay=0.02, joint=1, metadata={})
    arguments = ["diagnose", "--seconds", "0", *words]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert cli.main([*arguments, "--out", str(folder / "out")]) == 0
    return folder


def read_diagnosis(folder: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((folder / "out" / "diagnosis.json").read_text())
    return loaded


def test_a_command_delay_is_found_at_its_joint_and_the_interval_contains_the_true_value(
    delayed: Path,
) -> None:
    found = read_diagnosis(delayed)
    assert (found["schema"], found["verdict"]) == (1, "explained")
    (finding,) = found["findings"]
    assert (finding["effect"], finding["joint"]) == ("command_delay", "right")
    assert finding["path"] == "command"
    delay = finding["parameters"]["delay"]
    assert delay["unit"] == "s"
    assert delay["ci95"][0] <= 0.02 <= delay["ci95"][1]
    assert delay["ci95"][1] - delay["ci95"][0] < 0.005
    assert delay["value"] == pytest.approx(0.02, abs=0.0015)
    assert finding["held_out_gain"] > 0.98
    assert 0.0 < finding["confidence"] <= 1.0
    assert set(finding["where"]["windows"]) <= {"fit1.mcap", "fit2.mcap", "held_out3.mcap"}
    assert isinstance(finding["next_test"], str)


def test_the_diagnosis_result_is_valid_against_its_schema(delayed: Path) -> None:
    jsonschema.validate(read_diagnosis(delayed), load_schema("results/diagnosis.schema.json"))


def test_errors_are_those_of_the_held_out_recording(delayed: Path) -> None:
    found = read_diagnosis(delayed)
    assert set(found["held_out"]) == set(JOINTS)
    right, left = found["held_out"]["right"], found["held_out"]["left"]
    assert right["unit"] == "rad"
    assert right["rms_before"] > 10 * right["floor"] > right["rms_after"]
    assert left["rms_before"] == pytest.approx(left["rms_after"], rel=0.2)
    assert found["unexplained"] == {}
    assert found["trials"]["held_out"] == ["held_out3.mcap"]


def test_the_patched_model_is_plain_mjcf_and_the_nominal_model_is_not_changed(
    delayed: Path,
) -> None:
    folder = delayed / "out" / read_diagnosis(delayed)["realization"]
    model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    delay = read_diagnosis(delayed)["findings"][0]["parameters"]["delay"]["value"]
    assert model.actuator_delay.tolist() == pytest.approx([0.0, delay], rel=1e-5)
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.3
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert np.isfinite(data.qpos).all()
    nominal = mujoco.MjModel.from_xml_path(str(delayed / "model.xml"))
    assert nominal.actuator_delay.tolist() == [0.0, 0.0]


def test_a_replay_of_the_patched_model_has_the_reported_error(delayed: Path) -> None:
    out = delayed / "predicted.mcap"
    assert cli.main(["replay", str(delayed / "out"), str(delayed / "held_out3.mcap"),
                     "--out", str(out)]) == 0  # fmt: skip
    position = read_recording(out).series["state"].position
    measured = read_recording(delayed / "held_out3.mcap").series["state"].position
    assert position is not None
    assert measured is not None
    rms = np.sqrt(np.mean((position - measured) ** 2, axis=0))
    for joint, value in zip(JOINTS, rms, strict=True):
        error = read_diagnosis(delayed)["held_out"][joint]
        assert abs(value - error["rms_after"]) < 0.02 * error["floor"]


def test_the_diagnosis_report_is_one_page_without_external_files(delayed: Path) -> None:
    page = (delayed / "out" / "report.html").read_text()
    assert "command delay at joint right" in page
    responses = read_diagnosis(delayed)["frequency_response"]
    assert {one["joint"] for one in responses} == set(JOINTS)
    assert page.count("data:image/svg+xml;base64,") == 2 + len(responses)
    assert not re.search(r"(src|href)=\"(?!data:)", page)
    assert "<script" not in page
    assert page.index("Explained") < page.index("Findings")


def test_the_command_writes_no_file_outside_its_output_folder(delayed: Path) -> None:
    # A replay has written its prediction beside the recordings, and lists it there.
    theirs = {".pytest-twin", "predicted"}
    found = {p.name for p in delayed.iterdir() if p.stem not in theirs}
    assert found == {"model.xml", "fit1.mcap", "fit2.mcap", "held_out3.mcap", "out"}


def test_a_diagnosis_of_the_patched_model_finds_no_further_effect(
    delayed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "diagnose",
        "--seconds",
        "0",
        str(delayed / "out"),
        str(delayed / "fit1.mcap"),
        str(delayed / "held_out3.mcap"),
    ]
    assert cli.main([*words, "--out", str(delayed / "again")]) == 0
    found = json.loads((delayed / "again" / "diagnosis.json").read_text())
    assert found["verdict"] == "no_mismatch"
    kept = json.loads((delayed / "again" / "realization" / "effects.json").read_text())
    assert [(e["effect"], e["joint"]) for e in kept["effects"]] == [("command_delay", "right")]
    assert "No mismatch" in capsys.readouterr().out
    for path in (delayed / "again").rglob("*"):
        if path.is_file():
            path.unlink()
    for folder in sorted((delayed / "again").rglob("*"), reverse=True):
        folder.rmdir()
    (delayed / "again").rmdir()


def test_viscous_friction_is_found_with_its_coefficient(tmp_path: Path) -> None:
    arguments = case(tmp_path, joints=("left",), viscous=0.12)
    assert cli.main(["diagnose", "--seconds", "0", *arguments, "--out", str(tmp_path / "out")]) == 0
    (finding,) = read_diagnosis(tmp_path)["findings"]
    assert (finding["effect"], finding["joint"]) == ("viscous_friction", "left")
    coefficient = finding["parameters"]["coefficient"]
    assert coefficient["unit"] == "N*m*s/rad"
    assert coefficient["ci95"][0] <= 0.12 <= coefficient["ci95"][1]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "realization" / "model.xml"))
    assert model.dof_damping[0] == pytest.approx(0.05 + coefficient["value"], rel=1e-4)


def test_recordings_of_the_nominal_model_have_no_mismatch(tmp_path: Path) -> None:
    arguments = case(tmp_path, joints=("left",))
    assert cli.main(["diagnose", "--seconds", "0", *arguments, "--out", str(tmp_path / "out")]) == 0
    found = read_diagnosis(tmp_path)
    assert (found["verdict"], found["findings"], found["unexplained"]) == ("no_mismatch", [], {})


def test_a_note_says_that_findings_of_a_single_recording_are_not_tested(tmp_path: Path) -> None:
    (tmp_path / "model.xml").write_text(case(tmp_path, joints=("left",)) and (
        tmp_path / "model.xml").read_text())  # fmt: skip
    only = record(tmp_path / "only.mcap", 5, joints=("left",), viscous=0.12)
    loaded = load_model(tmp_path / "model.xml")
    trials = read_trials([only], [], loaded.topics, loaded.realization.structure)
    assert trials.held_out == ()
    assert any("one recording only" in note for note in trials.notes)
    found = diagnose(loaded.realization, trials)
    assert found.explanation.findings[0].effect == "viscous_friction"
    assert found.explanation.findings[0].confidence <= 0.9
    assert any("those of the fitted recordings" in note for note in found.notes)


def test_the_json_output_equals_the_written_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = case(tmp_path, joints=("left",))
    assert (
        cli.main(
            [
                "diagnose",
                "--seconds",
                "0",
                *arguments,
                "--out",
                str(tmp_path / "out"),
                "--json",
                "-",
            ]
        )
        == 0
    )
    out, err = capsys.readouterr()
    assert json.loads(out) == read_diagnosis(tmp_path)
    assert "No mismatch" in err
