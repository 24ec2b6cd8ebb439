"""A golden of a CSV recording depends on the metadata beside it."""

from __future__ import annotations

from pathlib import Path

from in_process import InProcess

from pytest_twin.gate.parts import collect_dependencies
from pytest_twin.gate.specs import load_golden, spec_paths
from pytest_twin.twin import load_twin

MODEL = """<mujoco><worldbody><body><joint name="j"/><geom size="0.1"/></body></worldbody>
<actuator><position joint="j" kp="10"/></actuator></mujoco>"""
GOLDEN = """schema: 1
kind: replay
target: {recording: log.csv}
tolerance: {angle_rms: 10 mrad}
"""


def recording_part(root: Path) -> object:
    twin = load_twin(root / "twin.yaml")
    goldens = [load_golden(path, twin) for path in spec_paths(twin)]
    found = collect_dependencies(twin, goldens, InProcess()).dependencies  # type: ignore[arg-type]
    (part,) = [value for name, value in found.parts.items() if name.startswith("recording:")]
    return part


def test_metadata_beside_a_recording_are_part_of_its_digest(tmp_path: Path) -> None:
    (tmp_path / "golden").mkdir()
    (tmp_path / "twin.yaml").write_text("schema: 1\nname: arm\nmodel: arm.xml\n")
    (tmp_path / "arm.xml").write_text(MODEL)
    (tmp_path / "log.csv").write_text("time,j.position,j.command\n0.0,0,0\n0.01,0,0\n")
    (tmp_path / "golden/replay.yaml").write_text(GOLDEN)
    without = recording_part(tmp_path)
    metadata = tmp_path / "log.csv.yaml"
    metadata.write_text("payload: kg05\n")
    light = recording_part(tmp_path)
    metadata.write_text("payload: kg10\n")
    assert len({str(without), str(light), str(recording_part(tmp_path))}) == 3
