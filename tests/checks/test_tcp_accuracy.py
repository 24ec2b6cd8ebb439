from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from check_robots import ARM, failed, measure

from pytest_twin.checks.base import NothingToProposeError
from pytest_twin.checks.tcp_accuracy import TcpAccuracy
from pytest_twin.errors import SpecError
from pytest_twin.gate.specs import load_golden
from pytest_twin.golden import Golden
from pytest_twin.metrics.pose import quaternion_of
from pytest_twin.realization import Realization, load
from pytest_twin.twin import load_twin

CHECK = TcpAccuracy()
PAGE = Path(__file__).resolve().parents[2] / "docs" / "kinds" / "tcp_accuracy.md"
JOINTS = ("pan", "lift", "elbow")
READINGS = np.random.default_rng(0).uniform(-1.0, 1.0, (8, 3))
BOUNDS = {"position": "1 um", "orientation": "1e-6 rad", "position_rms": "1 um"}


def rotation(axis: str, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    rows = {"y": [[c, 0, s], [0, 1, 0], [-s, 0, c]], "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}
    return np.array(rows[axis])


def expected_tool_pose(pan: float, lift: float, elbow: float) -> np.ndarray:
    """(4, 4) pose of the tool of ARM in the world, m, by explicit matrix products."""
    upper = rotation("z", pan) @ rotation("y", lift)
    fore = upper @ rotation("y", elbow)
    pose = np.eye(4)
    pose[:3, :3] = fore @ rotation("z", 0.3)
    pose[:3, 3] = [0, 0, 0.18] + upper @ [0, 0, 0.3] + fore @ [0, 0, 0.25]
    return pose


def tracker(readings: np.ndarray, *, offset: float = 0.0, points: bool = False) -> str:
    """CSV of measured tool poses; the elbow encoder reads ``offset`` (rad) too little."""
    prefix = "point.tcp" if points else "flange"
    parts = ["x", "y", "z"] if points else ["x", "y", "z", "qw", "qx", "qy", "qz"]
    header = ["id", *(f"joint.{name}" for name in JOINTS), *(f"{prefix}.{p}" for p in parts)]
    lines = [",".join(header)]
    for number, row in enumerate(readings):
        pose = expected_tool_pose(row[0], row[1], row[2] + offset)
        cells = [*row, *pose[:3, 3]]
        if not points:
            cells += list(quaternion_of(pose[:3, :3]))
        lines.append(",".join([f"m{number}", *(f"{cell:.12g}" for cell in cells)]))
    return "\n".join(lines) + "\n"


def cell(
    folder: Path,
    measurements: str,
    *,
    model: str = ARM,
    twin: str = "",
    tolerance: dict[str, str] = BOUNDS,
    frame: str = "tcp",
) -> tuple[Golden, Realization]:
    (folder / "golden").mkdir(exist_ok=True)
    (folder / "robot.xml").write_text(model)
    (folder / "twin.yaml").write_text(f"schema: 1\nname: arm\nmodel: robot.xml\n{twin}")
    (folder / "tracker.csv").write_text(measurements)
    spec: dict[str, Any] = {
        "schema": 1,
        "kind": "tcp_accuracy",
        "target": {"frame": frame, "measurements": "tracker.csv"},
        "tolerance": tolerance,
    }
    path = folder / "golden" / "tool.yaml"
    path.write_text(yaml.safe_dump(spec))
    loaded = load_twin(folder / "twin.yaml")
    return load_golden(path, loaded), load(folder / "robot.xml", twin=loaded)


def test_a_model_that_agrees_with_the_measurements_passes(tmp_path: Path) -> None:
    measures = measure(CHECK, *cell(tmp_path, tracker(READINGS)))
    assert {m.name for m in measures} == set(BOUNDS)
    assert failed(measures) == []
    assert all(m.against == "measurement" for m in measures)


def test_measured_points_bound_only_the_position(tmp_path: Path) -> None:
    measurements = tracker(READINGS, points=True)
    assert not failed(measure(CHECK, *cell(tmp_path, measurements, tolerance={"position": "1 um"})))
    with pytest.raises(SpecError, match="no orientation was measured"):
        measure(CHECK, *cell(tmp_path, measurements, tolerance={"orientation": "1 mrad"}))


def test_a_displaced_tool_fails_by_its_displacement(tmp_path: Path) -> None:
    moved = ARM.replace('pos="0 0 0.05" euler', 'pos="0 0 0.052" euler')
    faults = failed(measure(CHECK, *cell(tmp_path, tracker(READINGS), model=moved)))
    assert {m.name for m in faults} == {"position", "position_rms"}
    assert all(m.error == pytest.approx(0.002, abs=1e-9) for m in faults)


def test_a_failure_names_the_worst_measurement(tmp_path: Path) -> None:
    lines = tracker(READINGS).splitlines()
    cells = lines[6].split(",")
    cells[4] = str(float(cells[4]) + 0.003)
    lines[6] = ",".join(cells)
    faults = failed(measure(CHECK, *cell(tmp_path, "\n".join(lines) + "\n")))
    by_name = {m.name: m for m in faults}
    assert by_name["position"].subject == "tcp at measurement m5 (worst of 8)"
    assert by_name["position"].error == pytest.approx(0.003)
    assert by_name["position_rms"].subject == "tcp over 8 measurements (worst: m5)"
    assert by_name["position_rms"].error == pytest.approx(0.003 / 8**0.5)


def test_joint_readings_are_corrected_by_the_calibrated_zeros(tmp_path: Path) -> None:
    measurements = tracker(READINGS, offset=0.01)
    assert failed(measure(CHECK, *cell(tmp_path, measurements)))
    zeros = "calibration: {id: bench, joints: {elbow: {offset: 0.01}}}\n"
    assert not failed(measure(CHECK, *cell(tmp_path, measurements, twin=zeros)))


def test_a_calibrated_base_moves_the_predicted_tool(tmp_path: Path) -> None:
    base = "calibration: {id: bench, base: {position: [1, 0, 0.1], quaternion: [1, 0, 0, 0]}}\n"
    faults = failed(measure(CHECK, *cell(tmp_path, tracker(READINGS), twin=base)))
    assert {m.name for m in faults} == {"position", "position_rms"}
    assert faults[0].error == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("joint.lift", "joint.lifted", "no position of joint 'lift', which moves 'tcp'"),
        ("flange.", "camera_from_target.", "no measurement of frame 'tcp'"),
    ],
)
def test_measurements_without_a_joint_or_frame_are_refused(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    spec, arm = cell(tmp_path, tracker(READINGS).replace(old, new))
    with pytest.raises(SpecError) as caught:
        measure(CHECK, spec, arm)
    assert words in str(caught.value)
    assert caught.value.line is not None


def test_an_unknown_tool_frame_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="did you mean 'tcp'"):
        measure(CHECK, *cell(tmp_path, tracker(READINGS), frame="tcpp"))


def test_tcp_accuracy_depends_on_chain_zeros_base_and_measurements(tmp_path: Path) -> None:
    spec, arm = cell(tmp_path, tracker(READINGS))
    assert frozenset(CHECK.depends(spec, arm.structure)) == arm.structure.chain(["tcp"]) | {
        "calibration:pan",
        "calibration:lift",
        "calibration:elbow",
        "base:calibration",
        "file:tracker.csv",
    }


def test_no_tcp_accuracy_golden_is_proposed_without_measurements(tmp_path: Path) -> None:
    _, arm = cell(tmp_path, tracker(READINGS))
    with pytest.raises(NothingToProposeError, match=r"docs/kinds/tcp_accuracy\.md"):
        CHECK.first(arm)


def test_the_documented_tcp_accuracy_example_loads(tmp_path: Path) -> None:
    cell(tmp_path, tracker(READINGS))
    path = tmp_path / "golden" / "tool.yaml"
    path.write_text(PAGE.read_text().split("```yaml\n")[1].split("```")[0])
    assert load_golden(path, load_twin(tmp_path / "twin.yaml")).kind == "tcp_accuracy"
