"""``motors:`` of ``twin.yaml``: is a change that of one joint or of all motors of a type?"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from pytest_twin.cli import main

sys.path.append(str(Path(__file__).parents[1] / "identification"))
from arms import simulated_effort, true_arm, write_model, write_recording

pytestmark = pytest.mark.usefixtures("commands_in_process")
OLD = 5


def record(folder: Path, name: str, seed: int, **changes: float) -> Path:
    arm = true_arm(folder, **changes)
    time, position, effort = simulated_effort(arm, seed, seconds=12.0, rate=50.0)
    return write_recording(folder / name, time, position, effort)


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("robot")
    write_model(folder)
    (folder / "twin.yaml").write_text(
        "model: model.xml\nmotors: {servo_a: [shoulder, elbow]}\n", encoding="utf-8"
    )
    for seed in range(OLD):
        record(folder, f"old{seed}.csv", seed)
    return folder


def findings(robot: Path, model: str, new: list[Path], out: Path) -> list[dict[str, Any]]:
    earlier = [str(robot / f"old{k}.csv") for k in range(OLD)]
    assert main([
        "diagnose", str(robot / model), *map(str, new), "--before", *earlier, "--out", str(out),
    ]) < 2  # fmt: skip
    found: list[dict[str, Any]] = json.loads((out / "diagnosis.json").read_text())["findings"]
    return found


def test_a_law_of_all_motors_of_a_type_is_named_as_the_types(robot: Path, tmp_path: Path) -> None:
    new = [record(tmp_path, f"new{k}.csv", 11 + k, damping=2.3, elbow=1.4) for k in range(2)]
    named = findings(robot, "twin.yaml", new, tmp_path / "out")
    assert [(f["effect"], f["joint"]) for f in named] == [
        ("viscous_friction", "shoulder"),
        ("viscous_friction", "elbow"),
    ]
    assert {(f["scope"], f["motor"]) for f in named} == {("motor", "servo_a")}
    for finding in named:
        low, high = finding["change"]["coefficient"]["ci95"]
        assert low < 0.8 < high


def test_a_law_of_one_joint_is_not_smeared_over_its_type(robot: Path, tmp_path: Path) -> None:
    new = [record(tmp_path, f"new{k}.csv", 11 + k, damping=3.0) for k in range(2)]
    for model in ("model.xml", "twin.yaml"):
        (finding,) = findings(robot, model, new, tmp_path / f"out_{model}")
        assert (finding["effect"], finding["joint"]) == ("viscous_friction", "shoulder")
        assert (finding["scope"], finding["motor"]) == ("joint", None)


@pytest.mark.parametrize(
    ("motors", "problem"),
    [
        ("{a: [shoulder], b: [shoulder]}", "a joint has two types of motors"),
        ("{a: [shoulder, elbov]}", "the model has no joint 'elbov'"),
    ],
)
def test_unusable_types_are_refused_in_one_line(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], motors: str, problem: str
) -> None:
    twin = robot / "wrong.yaml"
    twin.write_text(f"model: model.xml\nmotors: {motors}\n", encoding="utf-8")
    new = record(tmp_path, "new.csv", 11)
    earlier = [str(robot / f"old{k}.csv") for k in range(OLD)]
    status = main([
        "diagnose", str(twin), str(new), "--before", *earlier, "--out", str(tmp_path / "out"),
    ])  # fmt: skip
    assert status == 2
    message = capsys.readouterr().err
    assert problem in message
    assert "wrong.yaml" in message
