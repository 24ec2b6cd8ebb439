"""Benchmarks that load robots in a child, as their pages print the commands."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def run(*arguments: str | Path) -> str:
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=ROOT, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.nightly
def test_the_table_of_robots_has_a_row_for_a_robot_with_every_time() -> None:
    pytest.importorskip("pinocchio")
    table = run("benchmarks/assets.py", "--only", "z1_description")
    (row,) = [line for line in table.splitlines() if line.startswith("| z1_description/")]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    # The meshes have package:// names, which MuJoCo's own loader refuses.
    assert cells[10] == "refuses"
    assert all(float(cells[at]) > 0.0 for at in (8, 9, 11))


def test_a_shipped_robot_is_loaded_by_each_loader(tmp_path: Path) -> None:
    pytest.importorskip("pinocchio")
    robot = tmp_path / "packages" / "maker" / "arm.urdf"
    robot.parent.mkdir(parents=True)
    robot.write_text('<robot name="arm"><link name="base"/></robot>')
    state = tmp_path / "state.jsonl"
    run("benchmarks/shipped.py", tmp_path / "packages", "--state", state)
    (line,) = map(json.loads, state.read_text().splitlines())
    assert line["loads"] == dict.fromkeys(("mujoco", "pinocchio", "here"), "loads")
