"""Every robot of this package passes the audit: colcon test --packages-select robot_description."""

from pathlib import Path

import pytest

from pytest_twin import cli

ROBOTS = sorted((Path(__file__).parents[1] / "urdf").glob("*.urdf"))


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda path: path.name)
def test_the_audit_has_no_critical_finding(robot: Path, tmp_path: Path) -> None:
    assert cli.main(["audit", str(robot), "--out", str(tmp_path)]) == 0
