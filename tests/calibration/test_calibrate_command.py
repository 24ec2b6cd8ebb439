"""Command ``calibrate``: from a plan and observations to ``calibration.json``."""

from __future__ import annotations

import json
from pathlib import Path

import cells
import fr3
import jsonschema
import numpy as np
import pytest

from pytest_twin import cli
from pytest_twin.formats.schema import load_schema
from pytest_twin.metrics.pose import pose_vector
from pytest_twin.realization.serial_chain import load_serial_chain

IN_PROCESS = pytest.mark.usefixtures("commands_in_process")
"""Of all tests but the first, which keeps the child process of the command."""

POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")


def write_cell(folder: Path, *, plan: str = "", rows: int = 30) -> cells.Cell:
    """Write a cell with an FR3 whose joint 4 has a zero error of 20 mrad."""
    (folder / "fr3.urdf").write_text(fr3.urdf())
    chain = load_serial_chain(folder / "fr3.urdf", "fr3_link8")
    rng = np.random.default_rng(3)
    zeros = np.array([0.0, 0.0, 0.0, 0.02, 0.0, 0.0, 0.0])
    cell = cells.joint_cell(rng, chain, rows, zeros=zeros)
    measured = cell.observations.camera_from_target
    joints = cell.observations.joints
    lines = [
        ",".join(
            [
                "id",
                *(f"joint.{name}" for name in joints),
                *(f"camera_from_target.{part}" for part in POSE),
            ]
        )
    ]
    for row, name in enumerate(cell.observations.ids):
        numbers = [*(values[row] for values in joints.values()), *pose_vector(measured[row])]
        lines.append(",".join([name, *(repr(float(value)) for value in numbers)]))
    (folder / "observations.csv").write_text("\n".join(lines) + "\n")
    (folder / "calibration.yaml").write_text(
        "calibration: cell_hand_eye\nrobot: fr3.urdf\nflange: fr3_link8\n"
        "observations: observations.csv\n"
        + (
            plan
            or "estimate: [joint_zeros, base_world, hand_eye]\ncamera: {mount: hand}\n"
            "hold_out: {fraction: 0.33, seed: 1}\naccept: {translation: 0.002, rotation: 0.0035}\n"
        )
    )
    return cell


def test_calibrate_writes_estimates_with_intervals_and_held_out_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_cell(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["calibrate", "calibration.yaml", "--out", "out"]) == 0
    found = json.loads(Path("out/calibration.json").read_text())
    jsonschema.validate(found, load_schema("results/calibrate.schema.json"))
    assert found["verdict"] == "accepted"
    assert list(found["records"]) == ["joint_zeros", "base_world", "hand_eye", "target_scale"]
    low, high = found["records"]["joint_zeros"]["values"]["fr3_joint4"]["ci95"]
    assert low < 0.02 < high
    hand_eye = found["records"]["hand_eye"]
    assert (hand_eye["parent"], hand_eye["child"]) == ("fr3_link8", "camera")
    assert found["held_out"]["translation_rms"] == pytest.approx(5e-4, rel=0.35)
    assert found["held_out"]["count"] == 10
    assert set(found["solvers"]) >= {"park", "least_squares"}
    assert found["inputs"]["observations.csv"]["sha256"]
    assert {path.name for path in Path("out").iterdir()} >= {
        "calibration.json",
        "calibrated.urdf",
        "easy_handeye2.calib",
        "static_transforms.sh",
    }
    scene = found["scene"]
    assert {one["name"] for one in scene["frames"]} == {"base", "fr3_link8", "camera", "target"}
    np.testing.assert_allclose(scene["chain"][-1]["xyz"], scene["frames"][1]["xyz"], atol=1e-12)
    assert len(scene["arrows"]) == 30
    errors = [one["error"] for one in scene["arrows"] if one["kind"] == "held_out"]
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(
        found["held_out"]["translation_rms"]
    )
    page = Path("out/calibration.html").read_text()
    titles = ("Estimates", "Regions of the workspace", "Workspace", "Next poses", "Not observable")
    assert all(f"<h2>{title} " in page for title in titles)
    for one in found["held_out"]["regions"]:
        assert f"{1e3 * one['translation_rms']:.3f}" in page
    out = capsys.readouterr().out
    assert "Accepted: cell_hand_eye" in out
    assert "fr3_joint4" in out
    # An edited export is refused before the next computation.
    Path("out/calibrated.urdf").write_text("mine")
    assert cli.main(["calibrate", "calibration.yaml", "--out", "out"]) == 2
    assert "out/calibrated.urdf: was written or changed by" in capsys.readouterr().err
    assert Path("out/calibrated.urdf").read_text() == "mine"


@IN_PROCESS
def test_zeros_of_the_first_and_last_joint_are_reported_as_unobservable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_cell(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["calibrate", "calibration.yaml", "--out", "out"]) == 0
    found = json.loads(Path("out/calibration.json").read_text())
    names = list(found["records"]["joint_zeros"]["values"])
    assert names == [f"fr3_joint{n}" for n in range(2, 7)]
    words = " ".join(found["unobservable"])
    assert "zero of fr3_joint1 and the rotation of the target in the base" in words
    assert "zero of fr3_joint7 and the rotation of the camera on the flange" in words


@IN_PROCESS
def test_a_calibration_with_errors_above_the_accepted_ones_is_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_cell(tmp_path, plan="estimate: [hand_eye, base_world]\naccept: {translation: 0.001}\n")
    monkeypatch.chdir(tmp_path)
    assert cli.main(["calibrate", "calibration.yaml", "--out", "out", "--json", "r.json"]) == 1
    found = json.loads(Path("r.json").read_text())
    assert found["verdict"] == "rejected"
    assert "accepted up to 1 mm" in found["reasons"][0]
    assert found == json.loads(Path("out/calibration.json").read_text())


@IN_PROCESS
@pytest.mark.parametrize("way", ["roots", "option"])
def test_a_plan_may_name_files_in_folders_that_are_declared(
    way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plan, shared = tmp_path / "plan", tmp_path / "shared"
    plan.mkdir()
    shared.mkdir()
    write_cell(plan)
    (plan / "fr3.urdf").rename(shared / "fr3.urdf")
    monkeypatch.chdir(plan)
    text = Path("calibration.yaml").read_text().replace("fr3.urdf", "../shared/fr3.urdf")
    Path("calibration.yaml").write_text(text)
    command = ["calibrate", "calibration.yaml", "--out", "out"]
    assert cli.main(command) == 2
    assert f"--root {shared} on the command line" in capsys.readouterr().err
    if way == "roots":
        Path("calibration.yaml").write_text(text + "roots: [../shared]\n")
    else:
        command += ["--root", "../shared"]
    assert cli.main(command) == 0


@IN_PROCESS
def test_a_missing_joint_column_is_refused_with_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_cell(tmp_path)
    monkeypatch.chdir(tmp_path)
    text = Path("observations.csv").read_text().replace("joint.fr3_joint5", "joint.elbow")
    Path("observations.csv").write_text(text)
    assert cli.main(["calibrate", "calibration.yaml", "--out", "out"]) == 2
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1
    assert "no column of joint 'fr3_joint5', which moves 'fr3_link8'" in err
    assert not Path("out").exists()
