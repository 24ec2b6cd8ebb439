"""Stages of ``realize`` are SimReady assets; the validator's results are evidence for the audit."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asset_robots import PANDA, ROBOTS, write_arm
from matplotlib.image import imread

from pytest_twin.asset import simready
from pytest_twin.audit.thumbnail import SIDE
from pytest_twin.cli import main
from pytest_twin.realization.usd_simready import face_normals

pytest.importorskip("urdf_usd_converter")
pytestmark = pytest.mark.usefixtures("commands_in_process")

_ENVIRONMENT = os.environ.get("TWIN_SIMREADY")
_OF_SIMULATORS = {"RB.011", "NEWTON.DJ.001", "NEWTON.BA.001", "MUJOCO.COL.001", "MUJOCO.DJ.001"}
"""Requirements of optional features that decide whether Newton and MuJoCo take the stage."""


def realized(urdf: Path, out: Path) -> Path:
    assert main(["realize", str(urdf), "--out", str(out)]) == 0
    return out / f"{urdf.stem}.usdc"


def validated(stage: Path, results: Path) -> int:
    assert _ENVIRONMENT is not None
    command = [f"{_ENVIRONMENT}/bin/simready-validate", "--profile", "Robot-Body", str(stage)]
    ran = subprocess.run([*command, "--output", str(results)], capture_output=True, check=False)
    return ran.returncode


def findings(stage: Path, evidence: Path, out: Path) -> dict[str, dict[str, Any]]:
    assert main(["audit", str(stage), "--evidence", str(evidence), "--out", str(out)]) == 0
    report = json.loads((out / f"{stage.name}.audit.json").read_text())
    return {row["id"]: row for row in report["findings"] if row["layer"] == "simready"}


@pytest.mark.skipif(_ENVIRONMENT is None, reason="needs tests/asset/simready_environment.sh")
@pytest.mark.parametrize(
    "urdf",
    [
        None,
        pytest.param(PANDA, marks=pytest.mark.nightly),
        ROBOTS / "solo_description/robots/solo12.urdf",
    ],
)
def test_the_validator_of_nvidia_passes_a_stage_and_the_audit_says_so(
    tmp_path: Path, urdf: Path | None
) -> None:
    stage = realized(urdf or write_arm(tmp_path), tmp_path / "out")
    results = tmp_path / "simready.json"
    assert validated(stage, results) == 0
    found = findings(stage, results, tmp_path)
    assert "simready.passed:profile 'Robot-Body 3.0.0'" in found
    optional = found["simready.optional:profile 'Robot-Body 3.0.0'"]["value"].split(", ")
    assert not _OF_SIMULATORS & set(optional)


@pytest.mark.skipif(_ENVIRONMENT is None, reason="needs tests/asset/simready_environment.sh")
def test_what_the_validator_refuses_is_a_warning_with_its_reason(tmp_path: Path) -> None:
    stage = realized(write_arm(tmp_path), tmp_path / "out")
    stage.with_suffix(".json").unlink()
    results = tmp_path / "simready.json"
    assert validated(stage, results) != 0
    found = findings(stage, results, tmp_path)
    failed = found.pop("simready.required:requirement 'SR.004'")
    assert "Required metadata fields are missing" in failed["title"]
    assert not any("passed" in name for name in found)


def test_a_stage_states_the_drives_normals_and_materials_that_its_urdf_implies(
    tmp_path: Path,
) -> None:
    from pxr import Usd, UsdGeom, UsdPhysics, UsdShade

    stage = Usd.Stage.Open(str(realized(PANDA, tmp_path / "out")))
    forces = {
        prim.GetName(): drive.GetMaxForceAttr().Get()
        for prim in stage.Traverse()
        for axis in ("angular", "linear")
        if (drive := UsdPhysics.DriveAPI.Get(prim, axis))
        and not drive.GetStiffnessAttr().Get()
        and not drive.GetDampingAttr().Get()
    }
    assert forces["panda_joint1"] == 87.0
    assert forces["panda_joint7"] == 12.0
    visible = [
        prim
        for prim in stage.Traverse()
        if prim.IsA(UsdGeom.Gprim) and UsdGeom.Imageable(prim).ComputePurpose() == "default"
    ]
    assert visible
    for prim in visible:
        assert UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
        mesh = UsdGeom.Mesh(prim)
        if mesh:
            normals = np.array(mesh.GetNormalsAttr().Get())
            assert np.allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)


def test_normals_of_polygons_point_outwards_and_a_face_without_area_has_one() -> None:
    points = np.array([[0, 0, 5], [1, 0, 5], [1, 1, 5], [0, 1, 5.0]])
    corners, counts = np.array([0, 1, 2, 3, 3, 2, 1, 0, 0, 1]), np.array([4, 3, 3])
    assert face_normals(points, corners, counts).tolist() == [[0, 0, 1], [0, 0, -1], [0, 0, 1]]


def test_metadata_comes_from_the_package_and_says_what_nobody_stated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    urdf = write_arm(tmp_path)
    stage = realized(urdf, tmp_path / "out")
    metadata = json.loads(stage.with_suffix(".json").read_text())
    assert metadata["author"] == metadata["asset_license"] == simready.NOT_STATED
    assert metadata["usd_date_generated"] == "1970-01-02"
    (urdf.parents[1] / "package.xml").write_text(
        "<package><name>arm_description</name><maintainer>B</maintainer><author>A</author>"
        "<license>BSD</license><license>MIT</license></package>"
    )
    stage = realized(urdf, tmp_path / "again")
    metadata = json.loads(stage.with_suffix(".json").read_text())
    assert (metadata["author"], metadata["asset_license"]) == ("A", "BSD, MIT")
    manifest = json.loads((stage.parent / "manifest.json").read_text())
    reports = manifest["states"]["normalized"]["reports"]
    assert {"arm.json", ".thumbs/256x256/arm.usdc.png"} <= set(reports)


@pytest.mark.usefixtures("rendered_figures")
def test_a_thumbnail_is_a_picture_of_the_robot(tmp_path: Path) -> None:
    stage = realized(PANDA, tmp_path / "out")
    pixels = imread(stage.parent / ".thumbs/256x256/panda.usdc.png")
    assert pixels.shape[:2] == (SIDE, SIDE)
    drawn = (pixels < 1.0).any(axis=2)
    assert 0.05 < drawn.mean() < 0.7
    assert np.ptp(np.flatnonzero(drawn.any(axis=1))) > 0.8 * SIDE


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}", "0 results for a stage of this name"),
        ('{"a/arm.usdc": {"features_summary": {}}}', "no feature was validated"),
        ('{"a/arm.usdc": {}}', "not a result of simready-validate"),
        ("[1", "not a result of simready-validate"),
    ],
)
def test_a_result_without_a_verdict_on_the_stage_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, words: str
) -> None:
    stage = realized(write_arm(tmp_path), tmp_path / "out")
    evidence = tmp_path / "simready.json"
    evidence.write_text(text)
    assert main(["audit", str(stage), "--evidence", str(evidence), "--out", str(tmp_path)]) == 2
    stderr = capsys.readouterr().err
    assert words in stderr
    assert len(stderr.strip().splitlines()) == 1


def test_a_result_older_than_the_stage_is_a_warning(tmp_path: Path) -> None:
    stage = realized(write_arm(tmp_path), tmp_path / "out")
    feature = {"passed": True, "blocking_failure": False}
    result = {"features_summary": {"FET": feature}, "profile_id": "P", "profile_version": "1"}
    evidence = tmp_path / "simready.json"
    evidence.write_text(json.dumps({"elsewhere/arm.usdc": result}))
    os.utime(evidence, (1, 1))
    assert set(findings(stage, evidence, tmp_path)) == {
        "simready.older:profile 'P 1'",
        "simready.passed:profile 'P 1'",
    }
