"""Goldens that test a calibration from two streams on the held-out periods of its record."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from test_time_offset import calibrated, write_streams

from pytest_twin.checks import check_of
from pytest_twin.checks.base import Measure
from pytest_twin.errors import SpecError
from pytest_twin.gate.specs import load_golden
from pytest_twin.realization import load
from pytest_twin.twin import load_twin

MODEL = """<mujoco><worldbody><body name="a"><joint name="elbow"/><geom size="0.1"/></body>
</worldbody></mujoco>"""
SPEC = """\
schema: 1
kind: calibration
target: {record: clocks, plan: plan.yaml, streams: {hand: hand.csv, camera: camera.csv.gz}}
tolerance: {position: 2 mm, orientation: 3.5 mrad}
"""


def write_twin(folder: Path) -> None:
    (folder / "model.xml").write_text(MODEL)
    (folder / "twin.yaml").write_text(
        "model: model.xml\ncalibrations: [{file: out/calibration.json}]\n"
    )
    (folder / "golden").mkdir()
    (folder / "golden" / "camera.yaml").write_text(SPEC)


def measures_of(folder: Path) -> dict[str, Measure]:
    twin = load_twin(folder / "twin.yaml")
    golden = load_golden(folder / "golden" / "camera.yaml", twin)
    check = check_of("calibration")
    seen = check.observe(golden, load(folder / "model.xml", twin=twin), lambda fraction: None)
    return {one.name: one for one in check.compare(golden, seen, None)}


@pytest.mark.parametrize(
    ("mount", "inverted", "drift"), [("hand", True, 1e-3), ("world", False, 0.0)]
)
def test_the_golden_of_a_calibration_from_streams_reproduces_the_errors_of_the_record(
    tmp_path: Path, mount: str, inverted: bool, drift: float
) -> None:
    write_streams(tmp_path, mount=mount, inverted=inverted, drift=drift)
    status, document = calibrated(tmp_path)
    assert status == 0
    assert document["records"]["time_offset"]["drift"]["used"] == (drift > 0.0)
    write_twin(tmp_path)
    found = measures_of(tmp_path)
    assert set(found) == {"position", "orientation"}
    for measure in found.values():
        assert measure.passed
        assert measure.error == pytest.approx(measure.golden, rel=1e-6)
    # With half of the time offset the errors are larger.
    document["records"]["time_offset"]["value"] /= 2.0
    (tmp_path / "out" / "calibration.json").write_text(json.dumps(document))
    assert measures_of(tmp_path)["position"].error > 1.5 * found["position"].error
    text = (tmp_path / "hand.csv").read_text()
    (tmp_path / "hand.csv").write_text(text + text.splitlines()[-1] + "\n")
    with pytest.raises(SpecError, match="not a file that clocks was made from"):
        measures_of(tmp_path)
    spec = (tmp_path / "golden" / "camera.yaml").read_text()
    (tmp_path / "golden" / "camera.yaml").write_text(
        spec.replace("streams: {hand: hand.csv, camera: camera.csv.gz}", "observations: hand.csv")
    )
    with pytest.raises(SpecError, match="no streams"):
        measures_of(tmp_path)
