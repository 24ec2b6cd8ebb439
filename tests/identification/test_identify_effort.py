"""Identification from measured effort, for an arm with known parameters."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from arms import JOINTS, REAL, simulated_effort, true_arm, write_model, write_recording

from pytest_twin import cli
from pytest_twin.formats.schema import load_schema
from pytest_twin.realization import load

pytestmark = pytest.mark.usefixtures("commands_in_process")


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The nominal model, two recordings for the fit and a held-out one."""
    folder = tmp_path_factory.mktemp("cell")
    write_model(folder)
    robot = true_arm(folder)
    for name, seed in (("one", 1), ("two", 2), ("check", 3)):
        write_recording(folder / f"{name}.csv", *simulated_effort(robot, seed))
    return folder


@pytest.fixture(scope="module")
def found(cell: Path) -> dict:
    words = [
        "identify", str(cell / "model.xml"), str(cell / "one.csv"), str(cell / "two.csv"),
        "--held-out", str(cell / "check.csv"), "--out", str(cell / "identified"),
    ]  # fmt: skip
    assert cli.main(words) == 0
    return json.loads((cell / "identified/identification.json").read_text())


def test_the_document_is_valid_and_the_result_is_accepted(found: dict) -> None:
    jsonschema.validate(found, load_schema("results/identify.schema.json"))
    assert found["verdict"] == "accepted"
    assert [s["stage"] for s in found["stages"] if s["state"] == "accepted"] == [
        "gravity", "inertia", "friction",
    ]  # fmt: skip


def test_each_accepted_stage_names_its_data(found: dict) -> None:
    for stage in found["stages"]:
        if stage["state"] == "accepted":
            assert set(stage["data"]) == {"one.csv", "two.csv"}
            assert sum(stage["data"].values()) == pytest.approx(1.0)


def test_the_true_parameters_lie_in_their_intervals(found: dict) -> None:
    true = {
        "shoulder.viscous_friction": REAL["damping"],
        "shoulder.coulomb_friction": REAL["friction"],
        "elbow.viscous_friction": REAL["elbow"],
        "elbow.coulomb_friction": 0.3,
        "mx1 + 0.5*m2": 4 * 0.3 + 2 * 0.5,
        "elbow.mx": 0.4,
    }
    for name, value in true.items():
        low, high = found["parameters"][name]["ci95"]
        assert low <= value <= high, name
        assert high - low < 0.2 * abs(value), name


def test_held_out_effort_is_predicted_to_within_the_noise(found: dict) -> None:
    for joint in JOINTS:
        error = found["held_out"][joint]
        assert error["effort_rms"] < 0.1
        assert error["effort_relative"] < 0.2 * error["effort_relative_nominal"]
        assert error["effort_unit"] == "N*m"


def test_the_fitted_model_has_the_true_parameters(cell: Path, found: dict) -> None:
    fitted = load(cell / "identified/realization/model.xml").model
    assert fitted.dof_damping == pytest.approx([REAL["damping"], REAL["elbow"]], abs=0.1)
    assert fitted.dof_frictionloss == pytest.approx([REAL["friction"], 0.3], abs=0.1)
    moment = fitted.body_mass[1] * fitted.body_ipos[1, 0] + 0.5 * fitted.body_mass[2]
    assert moment == pytest.approx(4 * 0.3 + 2 * 0.5, rel=0.01)
    assert found["physical"]["consistent"]


def test_the_covariance_agrees_with_the_intervals(found: dict) -> None:
    names, matrix = found["covariance"]["names"], np.array(found["covariance"]["matrix"])
    assert np.linalg.eigvalsh(matrix).min() > 0
    for at, name in enumerate(names):
        low, high = found["parameters"][name]["ci95"]
        assert 1.96 * np.sqrt(matrix[at, at]) == pytest.approx((high - low) / 2, rel=1e-3)


def test_the_page_gives_the_reason_of_every_stage(cell: Path, found: dict) -> None:
    page = (cell / "identified/identification.html").read_text()
    for stage in found["stages"]:
        assert stage["why"].replace("'", "&#39;") in page
        for name, share in stage.get("data", {}).items():
            assert f"{name} {100 * share:.0f} %" in page


def test_without_held_out_recording_the_result_is_not_accepted(
    cell: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["identify", str(cell / "model.xml"), str(cell / "one.csv"), "--out"]
    assert cli.main([*words, str(tmp_path / "out")]) == 1
    assert "nothing is held out: no result can be accepted" in capsys.readouterr().out
