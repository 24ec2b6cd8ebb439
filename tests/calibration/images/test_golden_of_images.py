"""Goldens that test a calibration from images with the target poses of its record."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("cv2")

from test_calibrate_images import calibrated, write_cell

from pytest_twin.checks import check_of
from pytest_twin.gate.specs import load_golden
from pytest_twin.realization import load
from pytest_twin.twin import load_twin

MODEL = """<mujoco><worldbody><body name="a"><joint name="elbow"/><geom size="0.1"/></body>
</worldbody></mujoco>"""
SPEC = """\
schema: 1
kind: calibration
target: {record: cell, plan: plan.yaml, observations: observations.csv}
tolerance: {position: 2 mm, orientation: 3.5 mrad}
"""


def test_the_golden_of_a_calibration_from_images_reproduces_the_errors_of_the_record(
    tmp_path: Path,
) -> None:
    write_cell(tmp_path)
    status, document = calibrated(tmp_path)
    assert status == 0
    (tmp_path / "model.xml").write_text(MODEL)
    (tmp_path / "twin.yaml").write_text(
        "model: model.xml\ncalibrations: [{file: out/calibration.json}]\n"
    )
    (tmp_path / "golden").mkdir()
    path = tmp_path / "golden" / "camera.yaml"
    path.write_text(SPEC)
    twin = load_twin(tmp_path / "twin.yaml")
    golden = load_golden(path, twin)
    check = check_of("calibration")
    realization = load(tmp_path / "model.xml", twin=twin)
    seen = check.observe(golden, realization, lambda fraction: None)
    for measure in check.compare(golden, seen, None):
        assert measure.passed
        # The errors in the record are those of the target poses with the final intrinsics.
        assert measure.error == pytest.approx(measure.golden, rel=0.02)
    assert seen.values["held_out"]["count"] == document["held_out"]["count"]
