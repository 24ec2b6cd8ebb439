"""Evidence about signs, zeros, ranges and commands confirms or contradicts the robot file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from audited import findings_of, only, write_clean

from pytest_twin.audit import evidence
from pytest_twin.errors import SpecError

FULL = """schema: 1
source: manual rev 3
tcp: tcp
mass: {value: 3.5, tolerance: 0.1, source: scale}
poses:
  bent: {elbow: 1.5707963}
joints:
  elbow:
    range: [-2, 2]
    velocity: 2
    effort: 20
    positive: {frame: tcp, along: [0, 1, 0]}
    zero: arm stretched out, p. 12
  shoulder:
    positive: {frame: tcp, along: [0, 0, -1]}
    zero: p. 12
  grip:
    positive: {frame: finger, along: [0, 1, 0], pose: bent}
    zero: closed
frames:
  - {frame: tcp, position: [0.62, 0, 0.15]}
  - {frame: tcp, pose: bent, position: [0.32, 0.3, 0.15], tolerance: 0.001}
commands:
  elbow: {means: position setpoint, unit: rad}
"""


def _rows(folder: Path, text: str) -> list[dict[str, Any]]:
    path = folder / "evidence.yaml"
    path.write_text(text)
    return findings_of(write_clean(folder), evidence.load(path))


def test_evidence_that_agrees_removes_the_unknown_findings(tmp_path: Path) -> None:
    # In the bent pose the finger moves along -x, not along y: its sign stays unclear.
    rows = _rows(tmp_path, FULL)
    assert [row["element"] for row in only(rows, "joints.sign_unclear")] == ["joint 'grip'"]
    assert [row for row in rows if row["severity"] in ("critical", "warning")] == []
    assert only(rows, "joints.sign_unknown") == []
    assert only(rows, "joints.zero_unknown") == []
    assert {row["element"] for row in only(rows, "commands.unknown")} == {
        "joint 'shoulder'",
        "joint 'grip'",
    }


@pytest.mark.parametrize(
    ("old", "new", "code", "severity"),
    [
        ("along: [0, 1, 0]}", "along: [0, -1, 0]}", "joints.sign_contradicted", "critical"),
        ("along: [0, 0, -1]", "along: [0.1, 0, 1]", "joints.sign_contradicted", "critical"),
        ("range: [-2, 2]", "range: [-1, 2]", "joints.range_contradicted", "critical"),
        ("range: [-2, 2]", "range: [-3, 3]", "joints.range_contradicted", "warning"),
        ("effort: 20", "effort: 12", "joints.effort_contradicted", "critical"),
        ("velocity: 2", "velocity: 3", "joints.velocity_contradicted", "warning"),
        ("[0.62, 0, 0.15]", "[0.62, 0, 0.16]", "frames.position_contradicted", "critical"),
        ("[0.32, 0.3, 0.15]", "[0.32, -0.3, 0.15]", "frames.position_contradicted", "critical"),
        ("value: 3.5,", "value: 5,", "inertia.mass_contradicted", "critical"),
        ("tcp: tcp", "tcp: tool", "frames.missing_tool", "critical"),
        ("  shoulder:", "  sholder:", "joints.evidence_unused", "warning"),
        ("  elbow: {means", "  elbw: {means", "commands.evidence_unused", "warning"),
    ],
)
def test_each_contradicted_property_is_a_finding(
    tmp_path: Path, old: str, new: str, code: str, severity: str
) -> None:
    assert FULL.count(old) == 1
    found = only(_rows(tmp_path, FULL.replace(old, new)), code)
    assert [row["severity"] for row in found] == [severity]


def test_an_undeclared_pose_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "evidence.yaml"
    path.write_text(FULL.replace("pose: bent, position", "pose: bend, position"))
    with pytest.raises(SpecError, match=r"evidence\.yaml:22: .*no such pose .*one of: bent"):
        evidence.load(path)
